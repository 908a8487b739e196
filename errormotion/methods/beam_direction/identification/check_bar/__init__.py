"""A check bar measured by a calibrated beam."""
