"""From counts to force, GRF and COP: pure functions on arrays, no files and no network."""

OFFLINE_LAG_MS = 100.0
"""Look-ahead of offline estimates: in sealed sessions, in `simulate` and in `estimate`."""
