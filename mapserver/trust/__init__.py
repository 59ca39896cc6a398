"""Which machines contradict all others, and which are excluded from the map.

`comparison` measures, `judgement` has the rules, `auditor` votes, `decisions` keeps who is trusted.
"""
