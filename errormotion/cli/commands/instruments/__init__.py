"""Instruments: benches, sessions, calibrations, simulators, monitors."""
