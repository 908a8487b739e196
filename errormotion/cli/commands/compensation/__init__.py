"""Thermal models, and what makes corrections of errors: tables, programs, offsets that follow the temperatures."""
