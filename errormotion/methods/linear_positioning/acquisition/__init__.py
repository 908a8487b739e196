"""Acquisition: an axis approaches its targets, and an interferometer or a tracker in line with it is read."""
