"""Frames as they come, crash-safe: segments with an index, streams of a node, and their notes."""
