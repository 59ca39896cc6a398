"""Machines that contradict all others, and their exclusion.

`comparison` measures, `judgement` has rules, `auditor` votes, `decisions` keeps results.
"""
