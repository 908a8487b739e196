"""The shipped demonstrations: campaigns on the virtual machine, and their results beside the truth."""
