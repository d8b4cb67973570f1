"""Other formats, read and written: a module for each.

Exports stand on `storage.sessions`, `storage.clock` and `storage.schema`, load traces on
`devices.emulation`. Touches no journal.
"""
