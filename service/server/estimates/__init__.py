"""What makes forces of the frames of a node as they come: calibration, tares, estimator."""
