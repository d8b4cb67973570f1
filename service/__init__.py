"""Programs: node, server, API, offline work, commands; and the pure estimation all of them use."""
