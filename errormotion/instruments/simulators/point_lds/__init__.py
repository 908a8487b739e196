"""Simulated point sensors."""
