"""Heat of the virtual machine: a thermal network, and the thermal state under a schedule."""
