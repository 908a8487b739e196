"""Simulated laser trackers."""
