"""The virtual world that simulated devices share: its clock, its machine in motion, its targets and trackers."""
