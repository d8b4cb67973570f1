"""The server: streams of nodes, live estimates, recording. It opens no hardware and serves no HTTP.

A *server's node* holds a node's streams, estimates, tares and clock; a *server's stream* holds the
journal of one stream and what the node has said of it.
"""
