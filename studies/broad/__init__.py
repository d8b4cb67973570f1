"""Benchmark over many random arrays of the broad part family, each calibrated on its own rig."""
