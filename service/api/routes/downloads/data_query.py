"""Queries of downloads: of one session, or of a take."""

from __future__ import annotations

from pydantic import Field

from service.api.routes.access import SecondsQuery
from storage.formats.export import ClockName
from storage.formats.options import FormatOptions
from storage.formats.slice import Slice
from storage.formats.written.format import Format
from storage.formats.written.parquet import PARQUET
from storage.formats.written.registry import SEVERAL, FormatName, format_named, together_named


class MadeQuery(SecondsQuery, FormatOptions):
    """Query shared by all downloads."""

    format: FormatName
    columns: str | None = Field(
        default=None,
        description="Names, comma-separated: of all tiles (`force_n`) or one (`force_n_0`).",
        examples=["t_ns,grf_n,force_n_0"],
    )
    marks: bool | None = Field(
        default=None,
        description="Adds `event`: the marker at the frame nearest in time; null elsewhere. "
        "Default: true, but false for Parquet, which is then the sealed file.",
    )

    @property
    def to(self) -> Format:
        """Format of the download."""
        return format_named(self.format)

    @property
    def has_marks(self) -> bool:
        """True if markers are included."""
        return self.to.is_marked if self.marks is None else self.marks

    @property
    def options(self) -> FormatOptions:
        """Options of the format."""
        return FormatOptions(**{name: getattr(self, name) for name in FormatOptions.model_fields})

    @property
    def slice(self) -> Slice:
        """Rows and columns."""
        names = [name.strip() for name in (self.columns or "").split(",")]
        return Slice(self.start_s, self.end_s, tuple(name for name in names if name))

    @property
    def clock_name(self) -> ClockName:
        """Clock whose time is added to the frames."""
        return "server"

    @property
    def canonical(self) -> str:
        """Text that is equal for equivalent queries."""
        part = self.slice
        columns = ",".join(part.columns)
        rows = f"{part.start_s}|{part.end_s}"
        options = self.options.model_dump_json(exclude_none=True)
        return f"{self.format}|{rows}|{columns}|{self.clock_name}|{self.has_marks}|{options}"


class DataQuery(MadeQuery):
    """Query for one session."""

    format: FormatName = PARQUET.name
    clock: ClockName = Field(
        default="node",
        description="`server` adds `t_server_ns`, the frame's time in the server's UTC, and its "
        "bound `t_server_uncertainty_ns`; null where the clocks were not compared.",
    )

    @property
    def clock_name(self) -> ClockName:
        """Clock whose time is added to the frames."""
        return self.clock

    @property
    def is_stored(self) -> bool:
        """True if the answer is the sealed file as it is."""
        is_plain = self.clock == "node" and not self.has_marks and not self.options.set_names
        return self.to is PARQUET and self.slice.is_all and is_plain


class TakeDataQuery(MadeQuery):
    """Query for a take, on the server's time axis."""

    format: FormatName = Field(description="One that holds several: " + ", ".join(SEVERAL) + ".")

    @property
    def to(self) -> Format:
        """Format of the download.

        Raises:
            UsageError: it is for one session only.
        """
        return together_named(self.format)
