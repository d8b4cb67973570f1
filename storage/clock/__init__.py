"""A node's clock against the server's: measurements, and the bounds they give."""
