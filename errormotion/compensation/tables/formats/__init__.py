"""Formats of compensation tables, one module each."""
