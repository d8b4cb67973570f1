"""Frames as they come, crash-safe: a journal for each stream, in segments with an index.

The journal itself is `journal`, `time_index`, `open_segments`, `segment` and `segment_format`; node
and server both use it, and `stream_notes`. Knows no network, and of sessions only the numbers that
they need.
"""
