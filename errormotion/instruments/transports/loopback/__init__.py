"""Servers of simulated devices on loopback, and the transport to them."""
