"""Frames with several distance sensors around a bar in the spindle, on one clock."""
