"""Debounce of an array's warnings, for a terminal and the node's status."""

from __future__ import annotations

from collections.abc import Mapping


class Notices:
    """Debouncer of warnings: a warning has to be present in two updates in a row.

    Shorter faults show only in the frames' flags.
    """

    def __init__(self) -> None:
        self._last: Mapping[str, str] = {}
        self._told: dict[str, str] = {}

    @property
    def lasting(self) -> tuple[str, ...]:
        """Texts of the present debounced warnings."""
        return tuple(self._told.values())

    def since(self, troubles: Mapping[str, str]) -> tuple[str, ...]:
        """Update with the present warnings; return messages about begun and ended ones.

        Args:
            troubles: texts of the present warnings, by faulty part.
        """
        lasting = {what: text for what, text in troubles.items() if self._last.get(what) == text}
        new = [text for what, text in lasting.items() if self._told.get(what) != text]
        over = [what for what in self._told if what not in troubles and what not in self._last]
        self._last = dict(troubles)
        self._told |= lasting
        return (*new, *(f"no longer: {self._told.pop(what)}" for what in over))
