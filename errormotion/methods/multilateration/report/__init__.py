"""Report chapter: multilateration."""
