"""Emulated instruments under the foot: force plate and pressure plate, with separate clocks."""
