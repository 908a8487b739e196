"""Sections of bench and campaign files: head, machine, limits, timeline."""
