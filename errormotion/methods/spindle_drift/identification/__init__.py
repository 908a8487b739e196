"""Identification: spindle drift, from raw data to errors with covariance."""
