"""From a scene to an open array, servo and reference sensor: real, emulated, or mixed."""
