"""Request handlers of the pages."""
