"""Motions and expected uncertainty of a campaign, before anything moves."""
