"""Live feed of every frame of a node, for programs."""
