"""Frames on the wire and on disk: one schema, and the files it is kept in. No network."""
