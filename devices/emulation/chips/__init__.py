"""Emulated chips at register level."""
