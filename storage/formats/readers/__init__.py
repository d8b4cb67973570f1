"""Readers of force tables of other programs: a module for each kind, one registry of all."""
