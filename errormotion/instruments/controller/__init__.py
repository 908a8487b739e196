"""Machine controllers."""
