"""The server: streams of nodes, live estimates, recording.

A *server's stream* is what came of a node's stream; a *server's node* is what it said of itself.
It knows no hardware and no HTTP: `service.api` asks it.
"""
