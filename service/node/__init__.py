"""The node: acquisition, journal, and the link to a server. No web page, no estimates."""
