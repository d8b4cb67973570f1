"""Programs: node, server, API, offline work, commands; and the pure estimation that they use."""
