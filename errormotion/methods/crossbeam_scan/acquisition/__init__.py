"""Acquisition: crossbeam scans."""
