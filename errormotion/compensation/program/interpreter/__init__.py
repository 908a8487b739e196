"""LinuxCNC's own interpreter: expansion of what the plain reader does not know, and agreement with it."""
