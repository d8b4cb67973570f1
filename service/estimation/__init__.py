"""From counts to force, GRF and COP: pure functions on arrays, no files and no network."""

LIVE_LAG_MS = 10.0
"""Look-ahead of estimates that are shown live, and of sessions that are not sealed yet."""
OFFLINE_LAG_MS = 100.0
"""Look-ahead of offline estimates: in sealed sessions, in `run_simulation` and in `estimate`."""
LONG_GAP_NS = 50_000_000
"""Longest time without a reading in which the foot cannot have been lifted and put down again."""
