"""Undetermined freedoms, outliers, and notes on both."""
