"""What has become wrong with an array, or right again, for people to read on a terminal."""

from __future__ import annotations

from collections.abc import Mapping


class Notices:
    """Reports what lasts; what comes and goes between two looks is only in the frames' flags."""

    def __init__(self) -> None:
        self._last: Mapping[str, str] = {}
        self._told: dict[str, str] = {}

    @property
    def lasting(self) -> tuple[str, ...]:
        """What is wrong, and lasts."""
        return tuple(self._told.values())

    def since(self, troubles: Mapping[str, str]) -> tuple[str, ...]:
        """What is new since the last look.

        Args:
            troubles: what is wrong now, in words, by what it is wrong with.
        """
        lasting = {what: text for what, text in troubles.items() if self._last.get(what) == text}
        new = [text for what, text in lasting.items() if self._told.get(what) != text]
        over = [what for what in self._told if what not in troubles and what not in self._last]
        self._last = dict(troubles)
        self._told |= lasting
        return (*new, *(f"no longer: {self._told.pop(what)}" for what in over))
