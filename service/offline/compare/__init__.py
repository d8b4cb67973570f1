"""Comparison of a session with a reference: alignment, errors with intervals. No file access."""
