"""Pieces that the sensors of the virtual machine measure: artefacts, bar, balls, planes, and their surfaces."""
