"""Raw data and the log of a run on disk, written during the measurement and complete at any time."""
