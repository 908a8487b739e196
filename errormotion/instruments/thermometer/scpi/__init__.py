"""Resistance thermometers and thermocouples at a data acquisition unit with SCPI commands."""
