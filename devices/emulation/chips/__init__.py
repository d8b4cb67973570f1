"""Emulated chips at register level: what the wires show of one part."""
