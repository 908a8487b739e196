"""Commands on plugins: list, show, check, and write new ones."""
