"""Readers and writers of other formats.

Exports use `storage.sessions`, `storage.clock` and `storage.schema`; load traces use
`devices.emulation`. No module reads a journal.
"""
