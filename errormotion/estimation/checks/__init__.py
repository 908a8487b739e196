"""Checks of a fit: outliers, what would not be found, and correlated residuals.

They see a fit only, nothing of methods. Their result is a changed problem or a factor, and a sentence for the notes.
"""
