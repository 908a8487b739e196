"""Planning of a multilateration: the expected uncertainty."""
