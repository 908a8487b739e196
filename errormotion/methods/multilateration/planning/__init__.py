"""Planning: multilateration, the uncertainty to expect before a measurement."""
