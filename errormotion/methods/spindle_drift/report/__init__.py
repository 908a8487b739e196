"""Report chapter: spindle drift."""
