"""Scene files: wiring of the tiles, ground, models. Opens no hardware."""
