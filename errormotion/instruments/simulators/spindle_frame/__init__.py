"""Simulated frames of sensors around a bar."""
