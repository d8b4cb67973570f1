"""Foot as a whole: geometry of its tiles, angle, contact."""

CONTACT_UNKNOWN = 255
"""Value of `contact` where it is unknown."""

LONG_GAP_NS = 50_000_000
"""Longest time without a reading in which the foot cannot have been lifted and put down again."""
