"""Files made on request: entity tags, names, and streaming."""

from __future__ import annotations

import hashlib
import re
from collections.abc import AsyncIterator, Callable, Generator
from http import HTTPStatus

import pyarrow as pa
from fastapi import Request, Response
from fastapi.responses import StreamingResponse
from pydantic import Field
from starlette.concurrency import iterate_in_threadpool, run_in_threadpool

from devices.errors import UsageError
from service.api.routes.common import SecondsQuery, has_matching_etag
from service.server.server import Server
from service.sessions.inputs import iterate_raw_frames_with_part
from service.version import SOFTWARE_VERSION
from storage.clock.table import CLOCK_NAME
from storage.formats.export import ClockName
from storage.formats.markers import (
    PLACEMENT_COLUMNS,
    PlacedMarkers,
    place_markers,
    place_session_markers,
)
from storage.formats.slice import FormatOptions, Slice
from storage.formats.writers.format import ExportFormat, to_ascii_line
from storage.formats.writers.registry import (
    MULTI_SESSION_FORMATS,
    FormatName,
    get_format,
    get_multi_session_format,
)
from storage.formats.writers.tables import PARQUET
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import Session


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
        return self.format_spec is PARQUET and self.slice.has_all_rows_and_columns and is_plain


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


Chunks = Generator[bytes, None, None]
REMARKS_HEADER = "Foottile-Remarks"
"""Header of what a format filled or left out; absent: nothing."""
_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9.-]+")
_NAME_LENGTH = 60


async def _hash_export(session: Session, query: ExportQuery, server: Server) -> bytes:
    """Return a hash of everything that an export of a session depends on."""
    beside = ""
    if query.clock_name == "server" or query.has_markers:  # markers are placed by the clocks
        beside = await run_in_threadpool(_clock_hash, session, server)
    if query.has_markers:
        beside += "".join(event.model_dump_json() for event in session.markers)
    if session.sha256 is not None:
        content = f"{session.sha256}|{pa.__version__}"
    else:
        recorded = server.recorder.get_ledger(session.id).recorded
        content = f"{session.id}|{session.state}|{recorded}"
    text = f"{content}|{query.canonical_text}|{beside}|{SOFTWARE_VERSION}"
    return hashlib.sha256(text.encode()).digest()


def _marker_headers(markers: list[PlacedMarkers]) -> dict[str, str]:
    """Return the header with the number of markers in the file."""
    total = sum(len(each.markers) for each in markers)
    left_out = sum(len(each.excluded) for each in markers)
    return {"Foottile-Markers": f"placed={total - left_out}, left-out={left_out}"}


def make_file_stem(name: str, id_: str, part: Slice) -> str:
    """Return a file's name without extension: the trial's name and id, and the seconds in it.

    Letters of the name that are not in every file system's alphabet are dashes.
    """
    name = _NOT_IN_NAMES.sub("-", name)[:_NAME_LENGTH].strip("-.")
    ends = [None if at_s is None else f"{at_s:.3f}s" for at_s in (part.start_s, part.end_s)]
    seconds = f"{ends[0] or 'begin'}-to-{ends[1] or 'end'}" if any(ends) else ""
    return "_".join(word for word in (name, id_, seconds) if word)


async def respond_with_export(
    sessions: list[Session],
    take_offsets_s: list[float],
    write: Callable[[list[PlacedMarkers] | None, list[str]], Chunks],
    query: ExportQuery,
    request: Request,
    server: Server,
    stem: str,
    headers: dict[str, str],
) -> Response:
    """Answer with a file of sessions in chunks, which are closed even if the client disconnects.

    Args:
        sessions: sessions in the file.
        take_offsets_s: each session's, as for `storage.formats.export.Export`.
        write: makes the chunks with the markers of each session, None: without markers; adds
            remarks to the list before the first chunk.
        query: query of the request.
        request: the request.
        server: the server.
        stem: file name without extension.
        headers: further headers.
    """
    hashes = [await _hash_export(each, query, server) for each in sessions]
    tag = hashlib.sha256(b"".join(hashes)).hexdigest()
    weak = "" if all(session.sha256 is not None for session in sessions) else "W/"
    headers |= {"ETag": f'{weak}"{tag}"'}
    headers |= {"Cache-Control": "private, no-cache", "Accept-Ranges": "none"}
    if has_matching_etag(request, tag):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    markers = None
    if query.has_markers:
        markers = [
            await run_in_threadpool(_place_markers, *each, query.slice, server)
            for each in zip(sessions, take_offsets_s, strict=True)
        ]
        headers |= _marker_headers(markers)
    remarks: list[str] = []
    chunks = write(markers, remarks)
    # The first chunk now: an invalid query is then an answer, not a broken download.
    first = await run_in_threadpool(next, chunks, None)
    if first is None:
        raise UsageError("the session has no frames")
    if remarks:
        headers[REMARKS_HEADER] = to_ascii_line("; ".join(remarks))
    headers["Content-Disposition"] = f'attachment; filename="{stem}{query.format_spec.ending}"'
    return StreamingResponse(
        iterate_chunks(chunks, first), headers=headers, media_type=query.format_spec.media_type
    )


def _place_markers(
    session: Session, take_offset_s: float, part: Slice, server: Server
) -> PlacedMarkers:
    if not session.markers:
        return PlacedMarkers(())
    if session.sha256 is not None:
        with server.sessions.open_frames(session.id, only_slices=True) as reader:
            return place_session_markers(reader, session.markers, part, take_offset_s)
    sources = server.recorder.collect_inputs_from_journals(session.id)
    times = (
        {name: getattr(frames, name) for name in PLACEMENT_COLUMNS} | {"part": columns["part"]}
        for frames, columns in iterate_raw_frames_with_part(sources)
    )
    axis = sources.compute_time_axis()
    return place_markers(session.markers, times, sources.make_clock_table(), part, axis=axis)


async def iterate_chunks(chunks: Chunks, first: bytes = b"") -> AsyncIterator[bytes]:
    """Yield chunks as they are made, and close their generator even if the client disconnects."""
    try:
        if first:
            yield first
        async for chunk in iterate_in_threadpool(chunks):
            if chunk:
                yield chunk
    finally:
        chunks.close()


def _clock_hash(session: Session, server: Server) -> str:
    path = server.sessions.folder.get_path(session.id) / CLOCK_NAME
    if session.sha256 is not None and path.is_file():
        return compute_sha256(path)
    return hashlib.sha256(repr(session.clock).encode()).hexdigest()
