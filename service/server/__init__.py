"""Server state: streams of nodes, live estimates, recording. No hardware access, no HTTP.

A `ServerNode` holds a node's streams, estimates, tares and clock; a `ServerStream` holds one
stream's journal and the node's report.
"""
