"""Identification: probed balls, from raw data to errors with covariance."""
