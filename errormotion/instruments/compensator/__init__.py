"""Compensators: drivers that write offsets to a machine."""
