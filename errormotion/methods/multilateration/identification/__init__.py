"""Identification: multilateration, from raw data to errors with covariance."""
