"""Targets, the order of their approaches, NC programs, and the expected uncertainty."""
