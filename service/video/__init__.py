"""Films of a session: time stamps, alignment with its frames, the foot's angle in them."""
