"""Interferometers."""
