"""A machine's record: every run of one or more folders with its figures of merit.

``runs`` reads what run folders state, keeps it for the next call, and selects; ``history`` follows one figure over
time.
"""

from errormotion.record.tree import open_run

__all__ = ["open_run"]
