"""The parts of ``make validate``, one module for each method."""
