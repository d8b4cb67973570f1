"""Messages of the websockets: link of nodes, live sockets; encoding, close codes."""
