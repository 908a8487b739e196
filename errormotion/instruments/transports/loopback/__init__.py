"""The end of the device: servers of simulators on loopback, and the transport to them."""
