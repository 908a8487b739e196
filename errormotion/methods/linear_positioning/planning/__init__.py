"""What is going to be measured: targets, the order of their approaches, programs, and the uncertainty to expect."""
