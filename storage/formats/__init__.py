"""Other formats, read and written: a module for each.

Stands on `storage.sessions` and `storage.schema`; touches no journal.
"""
