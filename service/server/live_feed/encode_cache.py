"""Cache of encoded messages, shared by readers of the same columns.

Bounded in bytes; the least recently used message is dropped first. Readers that keep up ask for the
newest batches, so these are in it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable

BYTES_MAX = 4 << 20
"""Limit per node: a second of 64 tiles at 544 Hz, more of fewer."""


class EncodeCache:
    """LRU cache of encoded messages, bounded in bytes."""

    def __init__(self, bytes_max: int = BYTES_MAX) -> None:
        self._messages: OrderedDict[Hashable, bytes] = OrderedDict()
        self._bytes_max = bytes_max
        self.size_bytes = 0
        """Total size of the cached messages."""

    def get(self, key: Hashable) -> bytes | None:
        """Return a message; None if it is not cached."""
        if (message := self._messages.get(key)) is not None:
            self._messages.move_to_end(key)
        return message

    def put(self, key: Hashable, message: bytes) -> None:
        """Add a message that is not cached."""
        self._messages[key] = message
        self.size_bytes += len(message)
        while self.size_bytes > self._bytes_max:
            self.size_bytes -= len(self._messages.popitem(last=False)[1])
