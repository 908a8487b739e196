"""Laser trackers: distances and directions to a reflector, and their exported tables."""
