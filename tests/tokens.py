"""The token of servers in tests that are not about tokens: whatever asks such a server has it."""

from __future__ import annotations

SHARED_TOKEN = "a-token-that-all-tests-share"  # noqa: S105  # of tests
SHARED_BEARER = {"Authorization": f"Bearer {SHARED_TOKEN}"}
