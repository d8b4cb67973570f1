"""A node's journals: frames in memory and in flight, and the retention that servers request.

`journal` has all streams, `stream` has one; the other modules have one task each. A server does
not use them.
"""
