"""Simulated machines that take offsets, with the part that a machine must have: bound, slew limit, watchdog."""
