"""Foot as a whole: geometry of its tiles, angle, contact."""

UNKNOWN = 255
"""Value of `contact` where it is unknown."""

UNSEEN_NS = 50_000_000
"""Longest time without a reading in which the foot cannot have been lifted and put down again."""
