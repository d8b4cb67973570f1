"""Grounds of an emulated foot: forces and angle over time, and the indenter with its converter."""
