"""The commands, one module each: what they do is in the packages below."""
