"""Freeing an I2C bus that somebody holds: clocks on its wires, and the multiplexers' RESET."""
