"""Signal chain from frames to forces, GRF and COP: applies the models that a scene names."""
