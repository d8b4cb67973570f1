"""Fault detection: stuck and clipping tiles, thermal drift, and baselines that are lost."""
