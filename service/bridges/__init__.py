"""Live outlets for other programs: Foxglove, LSL, MQTT; each a client of a server."""
