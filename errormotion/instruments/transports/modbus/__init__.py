"""Modbus TCP and RTU: client, frames, and a server for simulators."""
