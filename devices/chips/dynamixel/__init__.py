"""Dynamixel MX servos, read only: packets of both protocols, models, and the newest position."""
