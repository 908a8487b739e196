"""Drivers of sensors, controllers and thermometers, and their connections.

An instrument has three layers: a *transport* moves bytes (`instruments.transports`), a *codec* consists of pure
functions between bytes and values, a *driver* is a class. Each kind has a folder, each device a module or folder. The
`simulators` are below the drivers: they implement the wire protocol and read the truth from the twin.
"""
