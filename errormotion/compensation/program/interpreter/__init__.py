"""LinuxCNC's interpreter: expansion of programs that the plain reader does not support, and comparison with it."""
