"""A node's journals: frames that wait in memory or are in flight, what is dropped, what is wanted.

`journal` is all of it, `stream` one stream; what they stand on has a module for each thing. A
server has none of this.
"""
