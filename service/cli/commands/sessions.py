"""`foottile sessions`, `pull` and `export`: what was recorded, and how to get it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devices.errors import UsageError
from devices.text import escape_control_chars
from service.cli.format_options import FormatOption, with_format_options
from service.cli.many import (
    NOT_ALL,
    JobsOption,
    ManifestOption,
    SchedulerOption,
    is_one,
    run_many,
)
from service.cli.options import (
    CaOption,
    EndOption,
    JsonOption,
    StartOption,
    data_folder,
    output_path,
    print_json,
    progress,
    remark,
    say,
    stdout,
)
from storage.formats.options import FormatOptions
from storage.formats.writers.registry import MULTI_SESSION_FORMATS
from storage.sessions.sidecars import MARKERS_NAME

if TYPE_CHECKING:
    from storage.formats.export import ClockName
    from storage.sessions.filters import SessionFilter

SERVER = "http://127.0.0.1:8000"

_LONG = {"ledger", "markers", "clock", "calibration", "scene_content", "asked"}
"""What a list of sessions leaves out."""

ServerOption = Annotated[str | None, typer.Option(help=f"Address of the server; default {SERVER}.")]
ColumnsOption = Annotated[
    str | None, typer.Option(help="Names with commas between: t_ns,grf_n,force_n_0.")
]

ClockOption = Annotated[
    str, typer.Option(help="node, or server: adds t_server_ns and t_server_uncertainty_ns.")
]


def sessions_command(
    server: ServerOption = None,
    ca: CaOption = None,
    data: Annotated[
        Path | None, typer.Option(help="Data folder to look into, without any server.")
    ] = None,
    node: Annotated[
        list[str] | None, typer.Option(help="Only those of this node; again for others.")
    ] = None,
    tag: Annotated[
        list[str] | None, typer.Option(help="Only those with this tag; again: and that one.")
    ] = None,
    search: Annotated[
        str | None, typer.Option(help="Only those with this in name, subject, notes, tag or node.")
    ] = None,
    take: Annotated[str | None, typer.Option(help="Only those of this take.")] = None,
    since: Annotated[
        str | None,
        typer.Option(
            "--from", help="Only those started then or later: 2026-11-24 or 2026-11-24T08:00, UTC."
        ),
    ] = None,
    until: Annotated[
        str | None, typer.Option("--to", help="Only those started before that.")
    ] = None,
    complete: Annotated[
        str | None, typer.Option(help="true: all is there; false: some may come; lossy: never.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List recorded sessions, newest first.

    All of them, or those that fulfil all that is asked for.
    """
    from rich.markup import escape
    from rich.table import Table

    from storage.sessions.filters import SessionFilter, parse_completeness, parse_t_ns

    choice = SessionFilter(
        nodes=tuple(node or ()),
        tags=tuple(tag or ()),
        take=take,
        q=search,
        from_t_ns=None if since is None else parse_t_ns(since, where="--from"),
        to_t_ns=None if until is None else parse_t_ns(until, where="--to"),
        complete=None if complete is None else parse_completeness(complete, where="--complete"),
    )
    if server is not None and data is not None:
        raise UsageError("--server and --data are two places to look in", remedy="Name one")
    found = (
        _of_server(server or SERVER, ca, choice)
        if data is None
        else _in_folder(data_folder(data), choice)
    )
    if as_json:
        print_json({"items": found})
        return
    table = Table(box=None, pad_edge=False)
    for heading in ("session", "name", "node", "s", "frames", "markers", "state"):
        right = heading in ("s", "frames", "markers")
        # A row is one line: a name that goes on in the next could look like a line of ours.
        table.add_column(heading, justify="right" if right else "left", no_wrap=True)
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
            session["state"] + lossy + assumed,
        )
    stdout.print(table)


@with_format_options
def pull_command(
    out: Annotated[Path, typer.Option(help="Folder to put it in; made if absent.")],
    session: Annotated[str | None, typer.Argument(help="Id of the session.")] = None,
    take: Annotated[
        str | None,
        typer.Option(
            help="All sessions of this take, as one file on the server's axis of time: "
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
    """Download a sealed session: data, description, markers. Goes on where it was broken off.

    The data is compared with its hash. Some seconds or columns, another format, or all of a take,
    are made by the server for the asking, and are one file in --out. Exit code 3: the session is
    complete on disk, but lossy.
    """
    import foottile
    from service.pull import pull_export, pull_session, pull_take_export
    from storage.formats.slice import Slice
    from storage.formats.writers.parquet import PARQUET
    from storage.formats.writers.registry import get_format, get_multi_session_format

    if (session is None) == (take is None):
        raise UsageError("what is to be pulled", expected="the id of a session, or --take")
    own_clock = _clock_named(clock)
    chosen = get_format(to) if take is None else get_multi_session_format(to)
    part = Slice(start_s, end_s, _names(columns))
    with (
        foottile.connect(server or SERVER, ca=ca) as source,
        progress(f"pulling {session or take}"),
    ):
        if session is None:
            pulled = pull_take_export(source, str(take), out, part, chosen, options)
        elif (
            part.is_whole_session
            and chosen is PARQUET
            and not options.specified_names
            and own_clock == "node"
        ):
            pulled = pull_session(source, session, out)
        else:
            pulled = pull_export(source, session, out, part, chosen, options, own_clock)
    if as_json:
        print_json(pulled)
    elif "resumed_bytes" not in pulled:
        say(f"{pulled['path']}: {pulled['bytes']} bytes")
    else:
        say(f"{pulled['path']}: {pulled['frames']} frames, {pulled['bytes']} bytes, hash verified")
        if pulled["resumed_bytes"]:
            remark(f"{pulled['resumed_bytes']} bytes were there from before")
    if pulled["complete"] == "lossy":
        remark("the session is lossy: some frames are missing for good")
        raise typer.Exit(3)


@with_format_options
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
    data: Annotated[
        Path | None, typer.Option(help="Data folder of the server; default: the user's.")
    ] = None,
    start_s: StartOption = None,
    end_s: EndOption = None,
    columns: ColumnsOption = None,
    clock: ClockOption = "node",
    markers: Annotated[
        bool | None,
        typer.Option(
            "--markers/--no-markers",
            help="Add the column event: what people marked, at the frame nearest in time; default: "
            "if there are events beside the frames.",
        ),
    ] = None,
    take: Annotated[str | None, typer.Option(help="Those of this take in --data, --merge.")] = None,
    together: Annotated[
        bool,
        typer.Option(
            "--merge",
            help="All of them into one file, on the server's axis of time: "
            f"{', '.join(MULTI_SESSION_FORMATS)}.",
        ),
    ] = False,
    manifest: ManifestOption = None,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Of many sessions print each as a line of JSON.")
    ] = False,
    *,
    options: FormatOptions,
) -> None:
    """Write a sealed session, or a slice of it, in another format.

    Many sessions are written each into a folder of its id in --out; given again, the command goes
    on where it was broken off. Exit code 3: some of them failed.
    """
    from service.offline.archive.locations import is_remote
    from service.offline.export import ExportOptions, export_merged, export_session
    from storage.formats.slice import Slice
    from storage.formats.writers.registry import get_format

    own_clock = _clock_named(clock)
    if take is not None:
        if sessions:
            raise UsageError("--take and sessions are two ways to name them", remedy="Name one")
        sessions, together = _of_take(take, data), True
    part = Slice(start_s, end_s, _names(columns))
    wanted = ExportOptions(
        get_format(to).name, part, "server" if together else own_clock, markers, options
    )
    if together and (manifest is not None or is_remote(out)):
        raise UsageError(
            "--merge with --manifest, or into a URI", remedy="Name the sessions, and a file"
        )
    if not together and (not is_one(sessions, manifest) or is_remote(out)):
        from service.offline.archive.tasks import ExportTask

        summary = run_many(
            ExportTask(wanted),
            sessions,
            manifest,
            out=out,
            jobs=jobs,
            scheduler=scheduler,
            as_json=as_json,
        )
        if summary.states["failed"]:
            raise typer.Exit(NOT_ALL)
        return
    sources = [sealed_file(session, data) for session in sessions or [""]]
    path = output_path(Path(out), *sources)
    with progress(f"writing {path.name}"):
        if together:
            done = export_merged(sources, path, wanted)
        else:
            done = export_session(sources[0], path, wanted)
    say(f"{path}: {done.size_bytes} bytes")
    for marker in done.left_out_markers:
        remark(f"marker {marker.marker.label!r} is not in it: {marker.exclusion_reason}")
    for text in done.remarks:
        remark(text)
    if done.is_markers_file_missing:
        remark(f"without markers: there is no {MARKERS_NAME} beside {sources[0].name}")


def _clock_named(clock: str) -> ClockName:
    """Return the clock of an option.

    Raises:
        UsageError: there is no such clock.
    """
    from storage.formats.export import CLOCK_NAMES

    for name in CLOCK_NAMES:
        if name == clock:
            return name
    raise UsageError(f"--clock {clock!r}", expected=" or ".join(CLOCK_NAMES))


def _names(columns: str | None) -> tuple[str, ...]:
    return tuple(name.strip() for name in (columns or "").split(",") if name.strip())


def _of_take(take: str, data: Path | None) -> list[str]:
    """Ids of a take's sessions, in the order of their nodes.

    Raises:
        UsageError: there is none.
    """
    from storage.sessions.filters import SessionFilter

    found = _in_folder(data_folder(data), SessionFilter(take=take))
    if not found:
        raise UsageError(f"no session of take {take!r}", where=str(data_folder(data)))
    return [each["id"] for each in sorted(found, key=lambda each: (each["node"], each["id"]))]


def _of_server(url: str, ca: Path | None, choice: SessionFilter) -> list[Mapping[str, Any]]:
    import foottile

    def instant(t_ns: int | None) -> str | None:
        return None if t_ns is None else str(t_ns)

    with foottile.connect(url, ca=ca) as server:
        found = server.sessions(
            choice.q,
            node=choice.nodes,
            tag=choice.tags,
            take=choice.take,
            since=instant(choice.from_t_ns),
            until=instant(choice.to_t_ns),
            complete=choice.complete,
        )
        return [session.metadata for session in found]


def _in_folder(data: Path, choice: SessionFilter) -> list[Mapping[str, Any]]:
    from storage.sessions.folder import Completeness, Session, SessionsFolder

    if not data.is_dir():
        raise UsageError(f"no data folder {str(data)!r}")
    folder = SessionsFolder(data / "sessions")
    sessions, unreadable = folder.load_all()
    for session_id, error in unreadable.items():
        remark(f"session {session_id} is left out: {error}")
    for stray in folder.find_strays():
        remark(f"session folder {stray.name} is left out: {stray.error}")

    def complete(session: Session) -> Completeness:
        return False if session.ledger is None else session.ledger.completeness

    return [
        {
            **session.model_dump(mode="json", exclude=_LONG),
            "complete": complete(session),
            "marker_count": len(session.markers),
        }
        for session in sessions
        if choice.accepts(session, complete)
    ]


def sealed_file(session: str, data: Path | None) -> Path:
    """The sealed file that a path, a session's folder, or an id in a data folder means.

    Raises:
        UsageError: there is none.
    """
    from storage.sessions.folder import FRAMES_NAME, SessionsFolder

    path = Path(session)
    if path.is_file():
        return path
    if not path.is_dir():
        path = SessionsFolder(data_folder(data) / "sessions").get_path(session)
    if not (path / FRAMES_NAME).is_file():
        raise UsageError(
            f"no sealed session {session!r}",
            where=str(path),
            expected=f"a file, a folder with {FRAMES_NAME}, or the id of a session in --data",
        )
    return path / FRAMES_NAME
