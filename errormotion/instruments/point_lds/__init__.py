"""Point laser distance sensors."""
