"""Acquisition: multilateration."""
