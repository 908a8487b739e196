"""Commands on thermal models and compensation: tables, NC programs, offsets that follow the temperatures."""
