"""Identification: crossbeam scans, from raw data to errors with covariance."""
