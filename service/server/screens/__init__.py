"""What is shown of a server: live, to all screens that watch, and in the answers of its API."""
