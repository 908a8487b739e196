"""Comparison of error datasets: do several methods agree on one machine, where not, and what explains it."""
