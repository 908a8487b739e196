"""The commands, a folder for each group; the modules ``interface`` state their arguments."""
