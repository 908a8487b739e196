"""Plugins: those that are installed, and new ones."""
