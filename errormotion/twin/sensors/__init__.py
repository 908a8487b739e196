"""Sensors of the virtual machine: five sensors in a frame, point sensor, line profiler, touch probe."""
