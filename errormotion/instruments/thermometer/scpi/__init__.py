"""Resistance thermometers and thermocouples behind a data acquisition unit with SCPI commands."""
