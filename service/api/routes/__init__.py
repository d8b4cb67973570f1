"""HTTP API, one module per resource. Rules of sessions are elsewhere."""
