"""Live estimation of a node's frames: calibration, tares, estimator."""
