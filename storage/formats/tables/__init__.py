"""Tables of forces that other programs write: one module a format, one registry of all."""
