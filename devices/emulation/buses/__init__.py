"""Emulated bus at bit level, with its faults."""
