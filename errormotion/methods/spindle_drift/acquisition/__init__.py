"""Acquisition: spindle drift."""
