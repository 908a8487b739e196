"""CAN bus: frames, SDO clients and simulated nodes."""
