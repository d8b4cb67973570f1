"""The server: streams of nodes, live estimates, recording. It knows no hardware and no HTTP."""
