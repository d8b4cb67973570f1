"""A server with a node, as for tests of the service."""

from __future__ import annotations

from tests.service.conftest import (  # noqa: F401  # fixtures
    foottile,
    no_threads_left,
    node,
    node_of,
    running,
    serve_with,
    silence_s,
    tared,
)
