"""Simulated machines that accept offsets, with the functions required of a machine: limit, slew limit, watchdog."""
