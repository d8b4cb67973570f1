"""What stays open: nodes that bring frames, screens and programs that take them."""
