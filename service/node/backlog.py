"""What a server lacks of a node's past: numbers of several streams, in the order they are sent."""

from __future__ import annotations

from collections.abc import Iterable

from storage.intervals import Intervals


class Backlog:
    """Numbers still to be sent behind the newest ones.

    Args:
        lacks: streams and their numbers, most urgent first; a stream may come more than once.
    """

    def __init__(self, lacks: Iterable[tuple[str, Intervals]] = ()) -> None:
        self._lacks = [(boot_id, numbers) for boot_id, numbers in lacks if numbers]

    @property
    def count(self) -> int:
        """How many frames."""
        streams: dict[str, Intervals] = {}
        for boot_id, numbers in self._lacks:
            streams[boot_id] = numbers | streams.get(boot_id, Intervals())
        return sum(numbers.count for numbers in streams.values())

    def add(self, boot_id: str, first: int, last: int) -> None:
        """These frames could not be sent when they were new."""
        for stream, numbers in self._lacks:
            if stream == boot_id:
                numbers.add(first, last)
                return
        self._lacks.append((boot_id, Intervals([(first, last)])))

    def next(self, frames_max: int) -> tuple[str, int, int] | None:
        """Stream, first and last number of what is to be sent next; None: there is nothing."""
        for boot_id, numbers in self._lacks:
            for first, last in numbers:
                return boot_id, first, min(last, first + frames_max - 1)
        return None

    def done(self, boot_id: str, first: int, last: int) -> None:
        """These are sent, or cannot be."""
        gone = Intervals([(first, last)])
        left = [(s, n - gone if s == boot_id else n) for s, n in self._lacks]
        self._lacks = [(stream, numbers) for stream, numbers in left if numbers]
