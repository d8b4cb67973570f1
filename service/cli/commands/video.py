"""`foottile video`: films beside sessions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devices.errors import UsageError
from service.cli.align_options import AlignArguments, align_and_report
from service.cli.commands.sessions import find_sealed_file
from service.cli.options import (
    DataOption,
    JsonOption,
    add_options,
    echo,
    print_json,
    remark,
    show_progress,
)
from service.cli.track_options import TrackArguments, track_angle
from storage.sessions.folder import FRAMES_NAME

if TYPE_CHECKING:
    from storage.sessions.videos import Video

ACTIONS = {"add": "FILE", "list": "", "remove": "VIDEO", "align": "VIDEO", "track": "VIDEO"}
"""Actions, with what each needs behind the session."""


@add_options
def video_command(
    action: Annotated[str, typer.Argument(help=f"{', '.join(ACTIONS)}.")],
    session: Annotated[
        str, typer.Argument(help="Folder of a sealed session, or its id in --data.")
    ],
    target: Annotated[
        str | None, typer.Argument(metavar="[FILE|VIDEO]", help="Film to add; or id of a video.")
    ] = None,
    capture_rate: Annotated[
        float | None,
        typer.Option(
            help="add: pictures per second when it was taken, if it plays slower and the file does "
            "not say so."
        ),
    ] = None,
    *,
    aligning: AlignArguments,
    tracking: TrackArguments,
    data: DataOption = None,
    as_json: JsonOption = False,
) -> None:
    """Keep films beside a session: add, list, remove, align, track.

    add: copies the film, which is read first: a file that no decoder can read is refused. remove:
    deletes it with its alignment and tables. align: finds the film's time in the session, with its
    uncertainty. track: writes the foot's angle in each picture as a table, for `foottile estimate
    --angle`. A server may run at the same time.
    """
    from storage.sessions.videos import read_videos, remove_video

    needed = ACTIONS.get(action)
    if action == "track" and tracking.begin_s is not None:
        needed = ""  # points in space, without a video
    if needed is None:
        raise UsageError(f"video {action!r}", expected=f"one of {', '.join(ACTIONS)}")
    if bool(needed) != bool(target):
        raise UsageError(
            f"video {action} {session} {target or ''}".rstrip(),
            expected=f"`foottile video {action} SESSION {needed}`".replace(" `", "`"),
        )
    if capture_rate is not None and action != "add":
        raise UsageError("--capture-rate is for `foottile video add`")
    if aligning != AlignArguments() and action != "align":
        raise UsageError("--by and its options are for `foottile video align`")
    by_markers = aligning.by == "contact" and tracking != TrackArguments()
    if tracking != TrackArguments() and action != "track" and not by_markers:
        raise UsageError(
            "options of markers are for `foottile video track` and `align --by contact`"
        )
    folder = _find_session_folder(session, data)
    if action == "align":
        track = tracking.make_options().make_task_options() if by_markers else None
        align_and_report(folder, str(target), aligning, track, as_json=as_json)
        return
    if action == "track":
        track_angle(folder, target, tracking, as_json=as_json)
        return
    if action == "remove":
        remove_video(folder, str(target))
        return
    if action == "add":
        videos = [_add_video(folder, Path(str(target)), capture_rate)]
    else:
        videos, problems = read_videos(folder)
        for problem in problems:
            remark(f"left out: {problem}")
    if as_json:
        items = [video.model_dump(mode="json") for video in videos]
        print_json(items[0] if action == "add" else {"items": items})
        return
    for video in videos:
        echo(_format_video(video))


def _find_session_folder(session: str, data: Path | None) -> Path:
    """Return the folder of a sealed session.

    Raises:
        UsageError: there is none.
    """
    path = find_sealed_file(session, data)
    if path.name != FRAMES_NAME:
        raise UsageError(
            f"{session!r} is a file, and a video is kept in a session's folder",
            expected="the folder of a sealed session, or its id in --data",
            remedy="`foottile pull ID --out here` makes one",
        )
    return path.parent


def _add_video(folder: Path, film: Path, capture_rate_hz: float | None) -> Video:
    from service.video.worker import check_extra_installed, describe_film
    from storage.durable_files import translate_storage_errors
    from storage.sessions.videos import IncomingVideo

    check_extra_installed()
    if not film.is_file():
        what = "no such file" if not film.exists() else "it is no file"
        raise UsageError(what, where=str(film), expected="a film")
    with (
        show_progress(f"copying {film.name}") as report_step,
        translate_storage_errors(film),
        film.open("rb") as file,
        IncomingVideo(folder, film.name, film.stat().st_size) as incoming,
    ):
        while chunk := file.read(_CHUNK):
            incoming.write(chunk)
        report_step(f"reading {film.name}")
        return incoming.keep(lambda path: describe_film(path, str(film), capture_rate_hz))


_CHUNK = 4 << 20


def _format_video(video: Video) -> str:
    film = video.film
    rate = f"{film.rate_hz:g} pictures/s" + (" (variable)" if film.is_variable else "")
    aligned = "not aligned" if video.alignment is None else f"aligned by {video.alignment.method}"
    return (
        f"{video.id} {video.name}: {film.width_px} x {film.height_px}, {film.duration_s:.2f} s, "
        f"{film.picture_count} pictures, {rate}, {film.codec}, {video.size_bytes} bytes, {aligned}"
    )
