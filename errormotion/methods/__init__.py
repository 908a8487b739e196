"""Methods: one folder each, from what an instrument saw to an error dataset."""
