"""Acquisition: the axis moves to its targets, and an interferometer or a tracker in line with the axis is read."""
