"""Estimation, recording and command line: what runs on a laptop beside the robot."""
