"""Planning of the measurement of a beam's direction: set-up and expected uncertainty."""
