"""The pose of the profiler in the tool frame, from scans of a circular pocket."""
