"""Frames as they come, crash-safe: a journal for each stream, in segments with an index.

A journal is of `journal.py` down to the segment's bytes; what a node keeps around it (what waits in
memory, what is in flight, what is dropped) is from `node_journal.py` on. Touches `storage.wire`,
`storage.durable` and the disk; knows no network, and of sessions only which numbers they need.
"""
