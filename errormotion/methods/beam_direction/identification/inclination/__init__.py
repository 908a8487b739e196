"""Calibration of the inclination error of a point sensor."""
