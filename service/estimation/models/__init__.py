"""Models of disturbances, one module each: the effect on readings, and its correction."""
