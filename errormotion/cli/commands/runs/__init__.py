"""The record of a machine: runs, their truth, notes, and history."""
