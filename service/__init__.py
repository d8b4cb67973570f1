"""What runs: node, server, API, desk work, commands; and the pure estimation that all ask."""
