"""Simulated line profilers and their surfaces."""
