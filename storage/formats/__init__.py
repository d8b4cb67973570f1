"""Other formats, read and written: a module for each."""
