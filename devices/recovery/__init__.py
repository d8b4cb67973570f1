"""Recovery of an I2C bus that a chip holds: clocks on its wires, the multiplexers' RESET."""
