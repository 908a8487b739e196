"""Acquisition: probed balls."""
