"""Compiled loops over the targets of a network."""
