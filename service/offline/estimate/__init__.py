"""A session estimated again: all of it, some seconds, or piece after piece in turns."""
