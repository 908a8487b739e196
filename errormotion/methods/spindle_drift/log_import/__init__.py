"""Logs of a lab become raw datasets of the method: columns of text, described by a map."""
