"""Scene files: which tiles hang where, what the ground does, which models. Opens no hardware."""
