"""Short sessions with an instrument: recorded with what was read, repeated from the recording, and compared."""
