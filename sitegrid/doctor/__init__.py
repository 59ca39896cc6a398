"""What is wrong with this host's part of a site: for each topic what is looked at, and what that means.

Functions that look (`open_`, `ask_`, `read_`) change nothing; functions that judge (`check_`) are pure.
"""
