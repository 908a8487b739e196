"""Identification: beam direction, from raw data to errors with covariance."""
