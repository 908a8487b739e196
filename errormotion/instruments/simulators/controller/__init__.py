"""Simulated controllers."""
