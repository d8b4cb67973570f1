"""Models of the hardware at registers and bytes, and their world. Drivers never import it."""
