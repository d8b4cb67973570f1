"""A module per model: what an effect does to readings, and how that is undone."""
