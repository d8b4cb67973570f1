"""The server's face: REST, websockets, page, and who may ask."""
