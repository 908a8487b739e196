"""Crossbeam scan: thermal errors of a carriage from a line profiler that scans the same artefacts again and again.

Here so far: ``registration`` finds the pose of a warm scan on a cold one; ``edges`` and ``calibration`` find the
profiler's own pose from a circular pocket; ``chain`` takes registered poses to the six errors of the carriage.
"""
