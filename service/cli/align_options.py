"""Options of `foottile video align`, and its report."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devices.errors import UsageError
from service.cli.options import SECONDS_MAX, echo, print_json, remark, show_progress

if TYPE_CHECKING:
    from storage.sessions.videos import AlignmentMethod, Video

_METHODS: tuple[AlignmentMethod, ...] = ("light", "clock", "contact", "hand")
_NEEDED_BY = {"picture": "contact", "pair": "hand"}
_DRIFT_KNOWN = 0.9
"""Greatest uncertainty of a drift, of that before any measurement, that says something."""


@dataclass(frozen=True)
class AlignArguments:
    """Options of `foottile video align`."""

    by: Annotated[
        str | None,
        typer.Option(help="align: light (the node's lamp), clock (page /clock), contact or hand."),
    ] = None
    near: Annotated[
        float | None,
        typer.Option(
            min=-SECONDS_MAX,
            max=SECONDS_MAX,
            help="align: about when the film begins, seconds after the session's first frame, "
            "within 5 s.",
        ),
    ] = None
    picture: Annotated[
        list[int] | None,
        typer.Option(
            metavar="N",
            help="align --by contact: first picture of a contact, from 0: the page's number less 1 "
            "(repeat for several); or name markers with --tags or --dots.",
        ),
    ] = None
    pair: Annotated[
        list[str] | None,
        typer.Option(
            metavar="N=SECONDS",
            help="align --by hand: picture, from 0 (the page's number less 1), and its instant, "
            "seconds after the first frame (repeat for several).",
        ),
    ] = None
    replace: Annotated[
        bool, typer.Option("--replace", help="align: replace an alignment that says otherwise.")
    ] = False


def align_and_report(
    session_folder: Path,
    video_id: str,
    arguments: AlignArguments,
    track: dict[str, Any] | None,
    *,
    as_json: bool,
) -> None:
    """Align a video with its session, and report offset, drift and uncertainty.

    Args:
        session_folder: folder of the session.
        video_id: id of the video.
        arguments: options of the command.
        track: options of the task that tracks markers, by contact; None: pictures are named.
        as_json: print the video as JSON.

    Raises:
        FootTileError: no alignment is found, or options do not fit.
    """
    from service.video.methods import AlignmentOptions, align_video
    from storage.sessions.videos import find_video_folder, read_video

    method = next((each for each in _METHODS if each == arguments.by), None)
    if method is None:
        raise UsageError(f"--by {arguments.by or 'is missing'}", expected=", ".join(_METHODS))
    for name, by in _NEEDED_BY.items():
        if getattr(arguments, name) and arguments.by != by:
            raise UsageError(f"--{name} is for --by {by}")
    if method == "contact" and bool(arguments.picture) == (track is not None):
        raise UsageError(
            "touchdowns are not named, or twice",
            expected="--picture of each, or markers of the foot by --tags or --dots",
        )
    chosen = [_parse_pair(text) for text in arguments.pair or []]
    options = AlignmentOptions(
        near_s=arguments.near,
        pictures=tuple(arguments.picture or [picture for picture, _ in chosen]),
        instants_s=tuple(instant_s for _, instant_s in chosen),
        track=track if method == "contact" else None,
        replaces=arguments.replace,
    )
    video = read_video(find_video_folder(session_folder, video_id))
    count = video.film.picture_count
    with show_progress(f"aligning {video.name}") as report_step:
        video = align_video(
            *(session_folder, video_id, method, options),
            lambda picture: report_step(f"aligning {video.name}: {picture} of {count} pictures"),
        )
    if as_json:
        print_json(video.model_dump(mode="json"))
        return
    _report(session_folder, video)


def _report(session_folder: Path, video: Video) -> None:
    import numpy as np

    from service.video.session_time import read_session_time
    from storage.sessions.folder import FRAMES_NAME

    alignment = video.alignment
    assert alignment is not None  # noqa: S101
    begin_t_ns = read_session_time(session_folder / FRAMES_NAME).begin_t_ns
    ends_s = np.array([0.0, video.film.duration_s])
    begin_s = 1e-9 * (alignment.t_ns - begin_t_ns + alignment.to_session_ns(ends_s)[0])
    bound_ms = 1.96e-6 * alignment.compute_sigma_ns(ends_s).max()
    count = alignment.pair_count
    echo(
        f"{video.name}: by {alignment.method}, begins {abs(begin_s):.4f} s "
        f"{'after' if begin_s >= 0 else 'before'} the session, +- {bound_ms:.1f} ms (95 %) in all "
        f"of it, from {count} instant{'s' if count != 1 else ''}"
    )
    echo(
        f"drift: {1e6 * alignment.drift:.1f} +- {1.96e6 * alignment.sigma_drift:.1f} ppm (95 %)"
        if alignment.sigma_drift < _DRIFT_KNOWN * video.film.drift_sigma
        else f"drift: not measured, {1.96e6 * video.film.drift_sigma:.0f} ppm are allowed for"
    )
    if alignment.rejected_count:
        remark(f"{alignment.rejected_count} instants contradict the others, and were left out")


def _parse_pair(text: str) -> tuple[int, float]:
    picture, _, seconds = text.partition("=")
    try:
        number, instant_s = int(picture), float(seconds)
    except ValueError:
        number, instant_s = -1, math.nan
    if not abs(instant_s) <= SECONDS_MAX:
        raise UsageError(f"--pair {text!r}", expected="a picture and its instant, as 120=3.52")
    return number, instant_s
