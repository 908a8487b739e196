"""Commands on stored data: identify, validate, compare, report, and export."""
