"""MCAP writer: a session as messages of Foxglove or of ROS 2."""
