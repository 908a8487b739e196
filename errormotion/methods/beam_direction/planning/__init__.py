"""Planning: beam direction, the uncertainty to expect before a measurement."""
