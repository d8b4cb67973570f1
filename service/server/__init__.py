"""The server: streams of nodes, live estimates, recording. It knows no hardware and no HTTP.

A *server's node* is what a node said of itself, a *server's stream* what came of its streams.
"""
