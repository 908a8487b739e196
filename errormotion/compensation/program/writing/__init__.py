"""Correction and division of moves, and the lines of the new program."""
