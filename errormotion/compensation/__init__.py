"""Compensation of errors: thermal models, corrections, compensation tables and programs, online compensation."""
