"""Compensators: what writes offsets into a machine."""
