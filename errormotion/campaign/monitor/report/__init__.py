"""The report of a monitor."""
