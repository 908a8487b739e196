"""Evaluation of a check bar that is measured with a calibrated beam."""
