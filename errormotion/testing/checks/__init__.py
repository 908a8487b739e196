"""The checks, by topic or kind of plugin."""
