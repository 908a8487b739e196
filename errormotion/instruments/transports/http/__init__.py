"""HTTP: requests, streams of parts, and a server for simulators."""
