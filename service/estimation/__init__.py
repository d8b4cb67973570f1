"""From counts to force, GRF and COP: pure functions on arrays, no files and no network."""
