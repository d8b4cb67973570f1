"""Other formats, read and written: a module for each.

What is exported or imported is made of `storage.sessions` and `storage.schema`; nothing here touches
a journal.
"""
