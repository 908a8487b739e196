"""Displacements along diagonals of a volume (ISO 230-6), and squareness from pairs of face diagonals."""
