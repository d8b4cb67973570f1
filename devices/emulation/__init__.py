"""Register-level and byte-level models of the hardware, and the world they stand in."""
