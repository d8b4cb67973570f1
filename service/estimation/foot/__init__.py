"""The foot as a whole: where its tiles are, at what angle it stands, when it bears load."""

UNKNOWN = 255
"""Contact in a frame in which it is not known."""

UNSEEN_NS = 50_000_000
"""A foot not seen for longer than this may have been lifted and put down again."""
