"""Sensors, controllers and thermometers, and the wires they speak on.

A driver goes through three steps: a *transport* moves bytes (`instruments.transports`), a *codec* is pure functions
between bytes and values, a *driver* is one plain class. One folder a kind, one module or folder a device. The
`simulators` sit below the drivers: they speak the wire protocol and query the twin for the truth.
"""
