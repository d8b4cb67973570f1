"""Frames as they come, crash-safe: a journal for each stream, in segments with an index.

The journal itself is `journal`, `time_index`, `segment_writer` and `segment`; node and server both
use it, and `stream_notes`. Knows no network, and of sessions only the numbers that they need.
"""
