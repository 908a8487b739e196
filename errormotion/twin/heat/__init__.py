"""Heat of the virtual machine: a thermal network, and the state that follows from a schedule."""
