"""What plugins have to show, one module for each claim or kind of plugin."""
