"""Acquisition: a tracker at several stations measures the targets of the machine."""
