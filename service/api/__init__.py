"""The server's face: REST, websockets, page, and who may ask. What it does is the server's."""
