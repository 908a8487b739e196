"""What distances do not determine, readings that contradict the others, and notes on both."""
