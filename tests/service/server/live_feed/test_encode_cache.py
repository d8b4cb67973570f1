"""What was encoded for others is kept within bounds, whatever is asked for."""

from __future__ import annotations

from service.server.live_feed.encoder import EncodeCache


def test_what_was_used_least_lately_goes_and_no_more_is_kept_than_is_allowed() -> None:
    shared = EncodeCache(bytes_max=30)
    for key in range(3):
        shared.put(key, bytes(10))
    assert shared.get(0) is not None
    shared.put(3, bytes(10))
    assert [shared.get(key) is not None for key in range(4)] == [True, False, True, True]
    assert shared.size_bytes == 30
    shared.put("too much", bytes(100))
    assert shared.size_bytes == 0
