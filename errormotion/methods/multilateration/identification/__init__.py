"""Identification of volumetric errors: from raw data to errors with covariance."""
