"""A machine's record: every run of one or more folders with its figures of merit.

``scan`` finds run folders and reads what they state, ``index`` keeps it for the next call, ``listing`` selects.
"""
