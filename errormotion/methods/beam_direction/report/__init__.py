"""Report chapter: beam direction."""
