"""Simulated line profilers, and what lies before them."""
