"""Live outlets for other programs: Foxglove, LSL, MQTT, ROS 2; each a client of a server."""
