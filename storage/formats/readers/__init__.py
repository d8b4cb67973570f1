"""Readers of force tables of other programs: one module a format, one registry of all."""
