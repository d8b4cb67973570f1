"""From counts to force, GRF and COP: pure functions on arrays, no files and no network."""

OFFLINE_LAG_MS = 100.0
"""Look-ahead of estimates that nobody waits for: in sealed sessions, in `simulate`, `estimate`."""
