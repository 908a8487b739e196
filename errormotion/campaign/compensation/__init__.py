"""Compensation of a machine in operation, and its state for other processes."""
