"""Tiles behind multiplexers as one array: found, timed, scanned, and judged reading by reading."""
