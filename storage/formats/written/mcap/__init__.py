"""MCAP: a session as messages, Foxglove's or those of ROS 2, one way of writing for both."""
