"""Chip drivers: registers and data-sheet formulas over a bus, independent of arrays."""
