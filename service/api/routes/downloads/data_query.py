"""Queries of downloads: of one session, or of a take."""

from __future__ import annotations

from pydantic import Field

from service.api.routes.common import SecondsQuery
from storage.formats.export import ClockName
from storage.formats.options import FormatOptions
from storage.formats.slice import Slice
from storage.formats.writers.format import ExportFormat
from storage.formats.writers.parquet import PARQUET
from storage.formats.writers.registry import (
    MULTI_SESSION_FORMATS,
    FormatName,
    get_format,
    get_multi_session_format,
)


class ExportQuery(SecondsQuery, FormatOptions):
    """Query shared by all downloads."""

    format: FormatName
    columns: str | None = Field(
        default=None,
        description="Names, comma-separated: of all tiles (`force_n`) or one (`force_n_0`).",
        examples=["t_ns,grf_n,force_n_0"],
    )
    markers: bool | None = Field(
        default=None,
        description="Adds `event`: the marker at the frame nearest in time; null elsewhere. "
        "Default: true, but false for Parquet, which is then the sealed file.",
    )

    @property
    def format_spec(self) -> ExportFormat:
        """Format of the download."""
        return get_format(self.format)

    @property
    def has_markers(self) -> bool:
        """True if markers are included."""
        return self.format_spec.has_markers_by_default if self.markers is None else self.markers

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
    def canonical_text(self) -> str:
        """Text that is equal for equivalent queries."""
        part = self.slice
        columns = ",".join(part.columns)
        rows = f"{part.start_s}|{part.end_s}"
        options = self.options.model_dump_json(exclude_none=True)
        return f"{self.format}|{rows}|{columns}|{self.clock_name}|{self.has_markers}|{options}"


class DataQuery(ExportQuery):
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
        is_plain = (
            self.clock == "node" and not self.has_markers and not self.options.specified_names
        )
        return self.format_spec is PARQUET and self.slice.is_unrestricted and is_plain


class TakeDataQuery(ExportQuery):
    """Query for a take, on the server's time axis."""

    format: FormatName = Field(
        description="One that holds several: " + ", ".join(MULTI_SESSION_FORMATS) + "."
    )

    @property
    def format_spec(self) -> ExportFormat:
        """Format of the download.

        Raises:
            UsageError: it is for one session only.
        """
        return get_multi_session_format(self.format)
