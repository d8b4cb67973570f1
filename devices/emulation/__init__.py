"""Emulation of the hardware at the level of registers and bytes. Drivers never import it."""
