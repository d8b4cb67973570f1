"""What was encoded for one reader and serves others who ask for the same columns.

Bounded in bytes, whatever is asked for: what was used least lately goes first. Those who keep up
with a node ask for its newest pieces, so these are what it has.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable

BYTES_MAX = 4 << 20
"""Of one node: a second of 64 tiles at 544 Hz, more of fewer."""


class Shared:
    """Messages by what they are of."""

    def __init__(self, bytes_max: int = BYTES_MAX) -> None:
        self._messages: OrderedDict[Hashable, bytes] = OrderedDict()
        self._bytes_max = bytes_max
        self.bytes = 0
        """Of all that is kept."""

    def get(self, key: Hashable) -> bytes | None:
        """A message; None if it is not kept."""
        if (message := self._messages.get(key)) is not None:
            self._messages.move_to_end(key)
        return message

    def put(self, key: Hashable, message: bytes) -> None:
        """Keep a message that is not kept."""
        self._messages[key] = message
        self.bytes += len(message)
        while self.bytes > self._bytes_max:
            self.bytes -= len(self._messages.popitem(last=False)[1])
