"""Compensation of a machine while it works, and its state as other processes see it."""
