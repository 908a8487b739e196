"""The report chapters of thermal models."""
