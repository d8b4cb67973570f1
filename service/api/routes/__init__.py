"""The HTTP API, a module for each kind of thing. No rule of a session is here."""
