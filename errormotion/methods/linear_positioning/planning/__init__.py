"""Targets, the order of their approaches, and NC programs."""
