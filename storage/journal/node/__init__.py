"""A node's journals: frames in memory and in flight, retention, and servers' retention requests.

`journal` has all streams, `stream` has one; the other modules have one task each. A server uses
none of them.
"""
