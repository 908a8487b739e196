"""Calibrations that methods and instruments share: inclination error of point sensors, pre-travel of touch probes."""
