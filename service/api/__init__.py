"""HTTP server: REST, websockets, page, access control. Rules are in `service.server`."""
