"""Laser line profilers."""
