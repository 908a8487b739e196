"""Propagation of distributions by the Monte Carlo method, JCGM 101: of any model, and through a method's identify."""
