"""Instruments under the foot: a force plate and a pressure plate, with clocks of their own."""
