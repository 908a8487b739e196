"""From the raw dataset to errors with covariance, and to the figures of ISO 230-2 with their uncertainty."""
