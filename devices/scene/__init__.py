"""Scene files: which tiles hang where, what the ground does, and what the estimate needs."""
