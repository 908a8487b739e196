"""Texts of the page in other languages."""
