"""Offline commands: simulation, estimation, calibration, comparison, export and diagnosis."""
