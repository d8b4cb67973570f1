"""What a session is made of and where it ends: rules, sealing, tares; no network."""
