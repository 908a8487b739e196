"""Results: identify, validate, compare, show, and hand on to a spreadsheet."""
