"""Debounce of an array's warnings, for a terminal and the node's status."""

from __future__ import annotations

from collections.abc import Mapping


class WarningDebouncer:
    """Debouncer of warnings: a warning has to be present in two updates in a row.

    Shorter faults show only in the frames' flags.
    """

    def __init__(self) -> None:
        self._last: Mapping[str, str] = {}
        self._debounced: dict[str, str] = {}

    @property
    def debounced_texts(self) -> tuple[str, ...]:
        """Texts of the present debounced warnings."""
        return tuple(self._debounced.values())

    def update(self, warnings_by_part: Mapping[str, str]) -> tuple[str, ...]:
        """Update with the present warnings; return messages about begun and ended ones.

        Args:
            warnings_by_part: texts of the present warnings, by faulty part.
        """
        lasting = {
            what: text for what, text in warnings_by_part.items() if self._last.get(what) == text
        }
        new = [text for what, text in lasting.items() if self._debounced.get(what) != text]
        over = [
            what
            for what in self._debounced
            if what not in warnings_by_part and what not in self._last
        ]
        self._last = dict(warnings_by_part)
        self._debounced |= lasting
        return (*new, *(f"no longer: {self._debounced.pop(what)}" for what in over))
