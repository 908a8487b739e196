"""Identification of the direction of a beam: from raw data to errors with covariance."""
