"""The virtual world that simulated devices share: clock, motion of the machine, targets and trackers."""
