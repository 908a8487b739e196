"""NC programs (RS-274, ISO 6983) rewritten so that their cuts are where they were meant."""
