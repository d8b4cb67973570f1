"""The foot as a whole: where its tiles are, at what angle it stands, when it bears load."""
