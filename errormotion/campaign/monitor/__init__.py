"""Monitors: temperatures and working parameters of a machine over hours or weeks."""
