"""Touch probes."""
