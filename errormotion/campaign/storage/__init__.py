"""Raw data and the log of a run on disk: written while the method measures, complete at any time."""
