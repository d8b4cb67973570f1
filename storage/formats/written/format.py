"""What a format is: what it is called, what it can do, and how it is written."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib.util import find_spec

from devices.errors import Extra, UsageError, needs_extra
from storage.formats.export import Export

TABLE_OPTIONS = ("names", "times")
"""What every format knows that writes `Export.tables`."""


@dataclass(frozen=True)
class Format:
    """A format that sessions are written in.

    Attributes:
        name: as people ask for it.
        title: as menus call it.
        opened_by: some programs that open it, for people who have to choose.
        media_type: as HTTP calls it.
        write: gives the file in chunks; see the package.
        write_together: writes several sessions on one axis of time; None: it knows one only.
        suffix: of its files, without the dot; empty: the name.
        options: names of the fields of `FormatOptions` that it knows.
        takes_columns: can columns be chosen? Else it has those that it has.
        needs_forces: is there nothing to write in it of a session without estimates?
        needs_sealed: is it made of sealed sessions only?
        is_marked: are marks in it, unless they are left out?
        frames_max: more it does not take; None: any number.
        extra: what has to be installed for it; None: nothing.
        packages: modules of that extra by which it is seen whether it is.
    """

    name: str
    title: str
    opened_by: str
    media_type: str
    write: Callable[[Export], Iterator[bytes]]
    write_together: Callable[[Sequence[Export]], Iterator[bytes]] | None = None
    suffix: str = ""
    options: tuple[str, ...] = ()
    takes_columns: bool = True
    needs_forces: bool = False
    needs_sealed: bool = False
    is_marked: bool = True
    frames_max: int | None = None
    extra: Extra | None = None
    packages: tuple[str, ...] = ()

    @property
    def ending(self) -> str:
        """Of its files' names, without the dot."""
        return self.suffix or self.name

    @property
    def missing(self) -> str | None:
        """The extra that is not installed; None: it can be written here."""
        is_here = all(find_spec(package) is not None for package in self.packages)
        return None if is_here else self.extra

    def written(self, export: Export) -> Iterator[bytes]:
        """The file, in chunks.

        Raises:
            UsageError: it cannot have what is asked for: a column, an option, too many frames,
                a slice behind the session's end; before the first chunk.
        """
        self._check(export)
        with self._needed():
            yield from self.write(export)

    def written_together(self, exports: Sequence[Export]) -> Iterator[bytes]:
        """One file of several sessions, on one axis of time, in chunks.

        Raises:
            UsageError: as for `written`, of any of them; it holds one session only, or one has no
                time that the others share.
        """
        if self.write_together is None:
            raise UsageError(f"{self.name} holds one session only")
        for export in exports:
            self._check(export)
            if export.clock is None:
                raise UsageError(
                    "the nodes' own clocks are no common axis", remedy="Ask for the server's clock"
                )
        with self._needed():
            yield from self.write_together(exports)

    @property
    def holds_several(self) -> bool:
        """Can several sessions be in one file?"""
        return self.write_together is not None

    def _needed(self) -> AbstractContextManager[None]:
        if self.extra is None:
            return nullcontext()
        return needs_extra(self.extra, f"the format {self.name}")

    def _check(self, export: Export) -> None:
        for name in export.options.set_names:
            if name not in self.options:
                known = ", ".join(self.options)
                raise UsageError(
                    f"{self.name} has no option {name!r}",
                    expected=f"of its options: {known}" if known else "none for this format",
                )
        if export.part.columns and not self.takes_columns:
            raise UsageError(
                f"{self.name} has columns of its own, and none can be chosen",
                remedy="Leave columns out, or ask for Parquet, Arrow or CSV",
            )
        if self.needs_forces and not export.has_forces:
            why = export.notes.get("estimates")
            raise UsageError(
                f"{self.name} holds forces, and this session has none"
                + (f": {why}" if isinstance(why, str) else ""),
                where=export.called,
                remedy="Add them with `foottile estimate`, or ask for its counts as Parquet, "
                "Arrow or CSV",
            )
