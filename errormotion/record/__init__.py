"""The record of a machine: all runs of one or more folders with their figures of merit.

``runs`` reads, indexes and selects runs; ``history`` evaluates one figure over time.
"""

from errormotion.record.tree import open_run

__all__ = ["open_run"]
