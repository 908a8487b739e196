"""Crossbeam scan: thermal errors of a carriage from a line profiler that scans the same artefacts again and again.

Measuring: ``schedule`` and ``programs`` (what happens when, as NC programs), ``acquisition`` (the scans line by line),
``pocket`` (scans for the profiler's pose), ``live`` (what it shows meanwhile).
Identifying: ``cutting`` (scans out of the record), ``registration`` and ``registrations`` (warm scans on cold ones),
``strain`` and ``carriage`` (to the six errors of the carriage), ``artefact_check`` (artefacts that moved), ``curves``
(smooth curves), ``identification`` (all of it); ``edges``, ``calibration`` and ``pose_errors`` (the profiler's own
pose).
"""

from errormotion.methods.crossbeam_scan.method import CrossbeamScan

__all__ = ["CrossbeamScan"]
