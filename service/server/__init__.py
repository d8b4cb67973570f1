"""Server state: streams of nodes, live estimates, recording. No hardware access, no HTTP.

A `ServerNode` holds a node's streams, estimates, tares and clock; a `ServerStream` holds the
journal of one stream and the node's report of it.
"""
