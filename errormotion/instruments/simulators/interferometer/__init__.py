"""Simulated interferometers."""
