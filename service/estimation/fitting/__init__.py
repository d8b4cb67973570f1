"""Calibration from rig recordings: checks, fits and intervals. No estimate needs it."""
