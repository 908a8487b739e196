"""Reading of datasets from text files: logs and readings as CSV."""
