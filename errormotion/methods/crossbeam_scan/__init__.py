"""Crossbeam scan: thermal errors of a carriage from repeated scans of artefacts with a line profiler.

``acquisition`` measures scans and the pocket, with the schedule and its NC programs. ``identification`` cuts the scans
out of the record, registers warm scans onto cold ones (``registration``), transforms the result to the six errors of
the carriage, checks for artefacts that moved, and determines the pose of the profiler (``profiler_pose``).
``planning`` computes expected uncertainties, ``simulation`` raw data with a known truth, ``report`` chapters and
figures of merit.
"""

from errormotion.methods.crossbeam_scan.method import CrossbeamScan

__all__ = ["CrossbeamScan"]
