"""Tokens of servers that check them, and requests that need one."""

from __future__ import annotations

TOKEN = "a-token-of-these-tests"  # noqa: S105  # of these tests
BEARER = {"Authorization": f"Bearer {TOKEN}"}
CHANGES = (
    ("POST", "/sessions"),
    ("POST", "/sessions/20200101T000000Z-000000/stop"),
    ("PATCH", "/sessions/20200101T000000Z-000000"),
    ("POST", "/sessions/20200101T000000Z-000000/markers"),
    ("POST", "/nodes/bench/tare"),
    ("DELETE", "/nodes/bench/tares/1"),
)
