"""The server over HTTP: REST, websockets, page, and who may ask. Rules are in `service.server`."""
