"""What a tile's own readings show to be wrong with it: repeats, a clip, a baseline that is lost."""
