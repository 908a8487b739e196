"""Correction and division of moves, and output of the new program."""
