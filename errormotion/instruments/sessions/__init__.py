"""Short sessions with an instrument: recorded with their readings, repeated from the recording, and compared."""
