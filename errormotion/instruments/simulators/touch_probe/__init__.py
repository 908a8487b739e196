"""Simulated touch probes."""
