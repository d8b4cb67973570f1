"""Studies of FootTile: benchmarks of its models, and the paper's experiments again. No product."""
