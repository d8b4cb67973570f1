"""Tares: by hand, from a lead, in flight; drift of baselines between tares."""
