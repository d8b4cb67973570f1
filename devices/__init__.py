"""Hardware drivers, acquisition and emulation. No network, no Arrow, no commands."""
