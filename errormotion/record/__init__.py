"""A machine's record: every run of one or more folders with its figures of merit.

``entry`` reads what a run folder states, ``index`` keeps it for the next call, ``listing`` selects, ``history``
follows one figure over time.
"""

from errormotion.record.tree import open_run

__all__ = ["open_run"]
