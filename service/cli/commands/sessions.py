"""`foottile sessions`, `pull` and `export`: list, download and convert sessions."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import typer
from pydantic import ValidationError
from pydantic.fields import FieldInfo

from devices.errors import UsageError, escape_control_chars
from service.cli.multi_session import BatchOptions, is_single_session, run_task
from service.cli.options import (
    EXIT_INCOMPLETE,
    SESSION_REMEDY,
    CaOption,
    DataOption,
    EndOption,
    JsonOption,
    StartOption,
    add_options,
    echo,
    expand_options,
    format_not_sampled,
    print_json,
    remark,
    resolve_data_folder,
    resolve_output_path,
    show_progress,
    stdout,
)
from storage.formats.slice import FormatOptions
from storage.formats.writers.registry import FORMATS, MULTI_SESSION_FORMATS
from storage.sessions.metadata import MARKERS_NAME

if TYPE_CHECKING:
    from storage.formats.export import ClockName
    from storage.sessions.metadata import SessionFilter

FormatOption = Annotated[str, typer.Option("--format", help=", ".join(FORMATS) + ".")]


def add_format_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter `options` of a command by an option for each field of `FormatOptions`.

    Raises:
        UsageError: a value that `FormatOptions` rejects.
    """
    parameters = [
        _make_parameter(name, field) for name, field in FormatOptions.model_fields.items()
    ]
    return expand_options(command, "options", parameters, _make_options)


def _make_options(**values: Any) -> FormatOptions:
    try:
        return FormatOptions(**values)
    except ValidationError as error:
        (name, *_), why = error.errors()[0]["loc"], error.errors()[0]["msg"]
        option = f"--{str(name).replace('_', '-')}"
        raise UsageError(f"{option} {values[str(name)]!r}: {why}") from error


def _make_parameter(name: str, field: FieldInfo) -> inspect.Parameter:
    kinds = [kind for kind in get_args(field.annotation) if kind is not type(None)]
    choices = get_args(kinds[0]) if get_origin(kinds[0]) is Literal else ()
    text = f"{' or '.join(choices)}. {field.description}" if choices else field.description
    kind: Any = str if choices else kinds[0]
    annotation: Any = Annotated[kind | None, typer.Option(help=text)]
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation
    )


SERVER = "http://127.0.0.1:8000"

_UNLISTED_FIELDS = {"ledger", "markers", "clock", "calibration", "scene_content", "request"}
"""Fields that a list of sessions omits."""

ServerOption = Annotated[str | None, typer.Option(help=f"Address of the server; default {SERVER}.")]
ColumnsOption = Annotated[
    str | None, typer.Option(help="Comma-separated names: t_ns,grf_n,force_n_0.")
]

ClockOption = Annotated[
    str, typer.Option(help="node, or server: adds t_server_ns and t_server_uncertainty_ns.")
]


def sessions_command(
    server: ServerOption = None,
    ca: CaOption = None,
    data: Annotated[
        Path | None, typer.Option(help="Data folder to list, without a server.")
    ] = None,
    node: Annotated[
        list[str] | None, typer.Option(help="Filter by node (repeat for several).")
    ] = None,
    tag: Annotated[
        list[str] | None, typer.Option(help="Filter by tag (repeat to require several).")
    ] = None,
    search: Annotated[
        str | None, typer.Option(help="Filter by text in name, subject, notes, tag or node.")
    ] = None,
    take: Annotated[str | None, typer.Option(help="Filter by take.")] = None,
    since: Annotated[
        str | None,
        typer.Option("--from", help="Earliest start, UTC: 2026-11-24 or 2026-11-24T08:00."),
    ] = None,
    until: Annotated[str | None, typer.Option("--to", help="End of the starts, exclusive.")] = None,
    complete: Annotated[
        str | None,
        typer.Option(help="true: all sampled frames stored; false: undecided; lossy: frames lost."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List recorded sessions, newest first.

    Several filters must all match.
    """
    from rich.markup import escape
    from rich.table import Table

    from storage.sessions.metadata import SessionFilter, parse_completeness, parse_iso_or_t_ns

    filters = SessionFilter(
        nodes=tuple(node or ()),
        tags=tuple(tag or ()),
        take=take,
        q=search,
        from_t_ns=None if since is None else parse_iso_or_t_ns(since, where="--from"),
        to_t_ns=None if until is None else parse_iso_or_t_ns(until, where="--to"),
        complete=None if complete is None else parse_completeness(complete, where="--complete"),
    )
    if server is not None and data is not None:
        raise UsageError("--server and --data exclude each other", remedy="Name one")
    found = (
        _list_server_sessions(server or SERVER, ca, filters)
        if data is None
        else _list_folder_sessions(resolve_data_folder(data), filters)
    )
    if as_json:
        print_json({"items": found})
        return
    table = Table(box=None, pad_edge=False)
    # Ids are copied from here, so they are whole in a narrow terminal, too.
    id_chars = max((len(session["id"]) for session in found), default=0)
    table.add_column("session", no_wrap=True, min_width=id_chars)
    # A row is one line: a wrapped name could look like another row.
    for heading in ("name", "node"):
        table.add_column(heading, no_wrap=True)
    for heading in ("s", "frames", "markers"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("state")
    for session in found:
        lossy = ", lossy" if session["complete"] == "lossy" else ""
        assumed = ", scale assumed" if session["absolute_scale"] == "assumed" else ""
        table.add_row(
            session["id"],
            escape(escape_control_chars(session["name"])),
            escape(escape_control_chars(session["node"])),
            f"{session['duration_s']:.1f}",
            str(session["frames"]),
            str(session.get("marker_count", "")),
            session["state"] + lossy + format_not_sampled(session["not_sampled_share"]) + assumed,
        )
    stdout.print(table)


@add_format_options
def pull_command(
    out: Annotated[Path, typer.Option(help="Folder to write; created if missing.")],
    session: Annotated[str | None, typer.Argument(help="Id of the session.")] = None,
    take: Annotated[
        str | None,
        typer.Option(
            help="All sessions of this take, as one file on the server's time axis: "
            f"--format {', '.join(MULTI_SESSION_FORMATS)}."
        ),
    ] = None,
    server: ServerOption = None,
    ca: CaOption = None,
    start_s: StartOption = None,
    end_s: EndOption = None,
    columns: ColumnsOption = None,
    to: FormatOption = "parquet",
    clock: ClockOption = "node",
    as_json: JsonOption = False,
    *,
    options: FormatOptions,
) -> None:
    """Download a sealed session: data, description, markers. A repeated command resumes it.

    The data is verified by its hash. For a slice, another format or a take the server makes one
    file. Exit code 3: downloaded completely, but the session is lossy.
    """
    import foottile
    from service.pull import pull_export, pull_session, pull_take_export
    from storage.formats.slice import Slice
    from storage.formats.writers.registry import get_format, get_multi_session_format
    from storage.formats.writers.tables import PARQUET

    if (session is None) == (take is None):
        raise UsageError(
            "nothing to pull is named"
            if take is None
            else "a session and --take exclude each other",
            expected="a session's id, or --take",
            remedy="List both with `foottile sessions --json`" if take is None else "Name one",
        )
    clock_name = _parse_clock(clock)
    writer = get_format(to) if take is None else get_multi_session_format(to)
    part = Slice(start_s, end_s, _parse_names(columns))
    with (
        foottile.connect(server or SERVER, ca=ca) as source,
        show_progress(f"pulling {session or take}"),
    ):
        if session is None:
            pulled = pull_take_export(source, str(take), out, part, writer, options)
        elif (
            part.has_all_rows_and_columns
            and writer is PARQUET
            and not options.specified_names
            and clock_name == "node"
        ):
            pulled = pull_session(source, session, out)
        else:
            pulled = pull_export(source, session, out, part, writer, options, clock_name)
    if as_json:
        print_json(pulled)
    elif "resumed_bytes" not in pulled:
        echo(f"{pulled['path']}: {pulled['bytes']} bytes")
    else:
        echo(f"{pulled['path']}: {pulled['frames']} frames, {pulled['bytes']} bytes, hash verified")
        if pulled["resumed_bytes"]:
            remark(f"resumed after {pulled['resumed_bytes']} bytes")
    if pulled.get("remarks"):
        remark(pulled["remarks"])
    if pulled["complete"] == "lossy":
        remark("the session is lossy: frames are lost")
        raise typer.Exit(EXIT_INCOMPLETE)


@add_format_options
@add_options
def export_command(
    out: Annotated[str, typer.Option(help="File to write; for many sessions, a folder or URI.")],
    to: FormatOption,
    sessions: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="SESSION ...",
            help="A sealed file, a session's folder, or an id in --data; or many: folders, globs, "
            "URIs.",
        ),
    ] = None,
    data: DataOption = None,
    start_s: StartOption = None,
    end_s: EndOption = None,
    columns: ColumnsOption = None,
    clock: ClockOption = "node",
    markers: Annotated[
        bool | None,
        typer.Option(
            "--markers/--no-markers",
            help="Add the column event: marker labels, at the nearest frame; default: if the "
            "session has markers.",
        ),
    ] = None,
    take: Annotated[
        str | None, typer.Option(help="Sessions of this take in --data, with --merge.")
    ] = None,
    merge: Annotated[
        bool,
        typer.Option(
            "--merge",
            help="Write one file for all, on the server's time axis: "
            f"{', '.join(MULTI_SESSION_FORMATS)}.",
        ),
    ] = False,
    *,
    batch: BatchOptions,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print each of many sessions as a line of JSON.")
    ] = False,
    options: FormatOptions,
) -> None:
    """Write a sealed session, or a slice of it, in another format.

    Each of many sessions is written into a folder of its id in --out; a repeated command resumes.
    Exit code 3: some sessions failed.
    """
    from service.offline.archive.locations import is_remote
    from service.offline.export import ExportOptions, export_merged, export_session
    from storage.formats.slice import Slice
    from storage.formats.writers.registry import get_format

    clock_name = _parse_clock(clock)
    if take is not None:
        if sessions:
            raise UsageError("--take and sessions exclude each other", remedy="Name one")
        sessions, merge = _find_take_sessions(take, data), True
    part = Slice(start_s, end_s, _parse_names(columns))
    export_options = ExportOptions(
        get_format(to).name, part, "server" if merge else clock_name, markers, options
    )
    if merge and (batch.manifest is not None or is_remote(out)):
        raise UsageError(
            "--merge with --manifest, or into a URI", remedy="Name the sessions, and a file"
        )
    if not merge and (not is_single_session(sessions, batch.manifest) or is_remote(out)):
        from service.offline.archive.tasks import ExportTask

        summary = run_task(
            ExportTask(export_options),
            sessions,
            batch,
            out=out,
            as_json=as_json,
        )
        if summary.states["failed"]:
            raise typer.Exit(EXIT_INCOMPLETE)
        return
    sources = [find_sealed_file(session, data) for session in sessions or [""]]
    path = resolve_output_path(Path(out), *sources)
    with show_progress(f"writing {path.name}"):
        if merge:
            done = export_merged(sources, path, export_options)
        else:
            done = export_session(sources[0], path, export_options)
    echo(f"{path}: {done.size_bytes} bytes")
    for marker in done.left_out_markers:
        remark(f"marker {marker.marker.label!r} is left out: {marker.exclusion_reason}")
    for text in done.remarks:
        remark(text)
    if done.is_markers_file_missing:
        remark(f"without markers: there is no {MARKERS_NAME} beside {sources[0].name}")


def _parse_clock(clock: str) -> ClockName:
    """Return the clock of an option.

    Raises:
        UsageError: no such clock.
    """
    from storage.formats.export import CLOCK_NAMES

    for name in CLOCK_NAMES:
        if name == clock:
            return name
    raise UsageError(f"--clock {clock!r}", expected=" or ".join(CLOCK_NAMES))


def _parse_names(columns: str | None) -> tuple[str, ...]:
    return tuple(name.strip() for name in (columns or "").split(",") if name.strip())


def _find_take_sessions(take: str, data: Path | None) -> list[str]:
    """Return ids of a take's sessions, ordered by node.

    Raises:
        UsageError: no session.
    """
    from storage.sessions.metadata import SessionFilter

    found = _list_folder_sessions(resolve_data_folder(data), SessionFilter(take=take))
    if not found:
        raise UsageError(f"no session of take {take!r}", where=str(resolve_data_folder(data)))
    return [each["id"] for each in sorted(found, key=lambda each: (each["node"], each["id"]))]


def _list_server_sessions(
    url: str, ca: Path | None, filters: SessionFilter
) -> list[Mapping[str, Any]]:
    import foottile

    def instant(t_ns: int | None) -> str | None:
        return None if t_ns is None else str(t_ns)

    with foottile.connect(url, ca=ca) as server:
        found = server.sessions(
            filters.q,
            node=filters.nodes,
            tag=filters.tags,
            take=filters.take,
            since=instant(filters.from_t_ns),
            until=instant(filters.to_t_ns),
            complete=filters.complete,
        )
        return [session.metadata for session in found]


def _list_folder_sessions(data: Path, filters: SessionFilter) -> list[Mapping[str, Any]]:
    from storage.sessions.folder import Completeness, Session, SessionsFolder

    if not data.is_dir():
        raise UsageError(f"no data folder {str(data)!r}")
    folder = SessionsFolder(data / "sessions")
    sessions, unreadable = folder.load_all()
    for session_id, error in unreadable.items():
        remark(f"session {session_id} is left out: {error}")
    for stray in folder.find_renamed_or_copied_sessions():
        remark(f"session folder {stray.name} is left out: {stray.error}")

    def complete(session: Session) -> Completeness:
        return False if session.ledger is None else session.ledger.completeness

    return [
        {
            **session.model_dump(mode="json", exclude=_UNLISTED_FIELDS),
            "complete": complete(session),
            "missed_slots": 0 if session.ledger is None else session.ledger.missed_slots,
            "not_sampled_share": 0.0
            if session.ledger is None
            else session.ledger.not_sampled_share,
            "lost": {} if session.ledger is None else session.ledger.lost,
            "marker_count": len(session.markers),
        }
        for session in sessions
        if filters.accepts(session, complete)
    ]


def find_sealed_file(session: str, data: Path | None) -> Path:
    """Return the sealed file of a path, a session's folder, or an id in a data folder.

    Raises:
        UsageError: no sealed file.
    """
    from storage.sessions.folder import FRAMES_NAME, SESSION_ID

    path = Path(session)
    if path.is_file():
        return path
    if not path.is_dir() and SESSION_ID.fullmatch(session):
        path = resolve_data_folder(data) / "sessions" / session
    if not (path / FRAMES_NAME).is_file():
        raise UsageError(
            f"no sealed session {session!r}",
            where=str(path),
            expected=f"a file, a folder with {FRAMES_NAME}, or the id of a session in --data",
            remedy=SESSION_REMEDY,
        )
    return path / FRAMES_NAME
