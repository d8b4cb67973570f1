"""What the hardware is, how it is asked, and its emulation. No network, no Arrow, no commands."""
