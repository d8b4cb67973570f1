"""A node's journals: frames in memory and in flight, retention, and servers' retention requests.

`journal` is all of it, `stream` one stream; the modules under them have one task each. A server has
none of this.
"""
