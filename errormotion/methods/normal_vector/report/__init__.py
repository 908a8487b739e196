"""Report chapter: probed balls."""
