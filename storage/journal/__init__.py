"""Frames as they come, crash-safe: a journal for each stream, in segments with an index.

The journal itself is `journal`, `open_segments`, `segment` and `segment_format`; node and server
both use it, and `stream_notes`. What a node keeps around it (frames that wait in memory or are in
flight, what is dropped, what servers want) is `node_journal`, `node_stream`, `in_flight`,
`left_over`, `retention` and `wanted`. Knows no network, and of sessions only the numbers that they
need.
"""
