"""Readers and writers of other formats, one module each.

Exports use `storage.sessions`, `storage.clock` and `storage.schema`; load traces use
`devices.emulation`. No module reads a journal.
"""
