"""The wires of the emulated bus at the level of bits, and what can be wrong with them."""
