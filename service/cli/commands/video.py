"""`foottile video`: films beside sessions: add, list, remove, align, track."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from devices.errors import UsageError
from service.cli.commands.sessions import find_sealed_file
from service.cli.options import (
    SECONDS_MAX,
    DataOption,
    JsonOption,
    add_options,
    echo,
    print_json,
    remark,
    resolve_output_path,
    show_progress,
    show_progress_bar,
)
from storage.sessions.folder import FRAMES_NAME

if TYPE_CHECKING:
    from service.video.angle import TrackedAngle
    from storage.sessions.videos import Video

SessionArgument = Annotated[
    str, typer.Argument(help="Folder of a sealed session, or its id in --data.")
]
VideoArgument = Annotated[str, typer.Argument(help="Id of the video.")]

_CHUNK_BYTES = 4 << 20
_DRIFT_KNOWN = 0.9
"""Greatest uncertainty of a drift, of that before any measurement, that says something."""
_TAG_MAX = 49
NEAR_WITHIN_S = 5.0


def video_add_command(
    session: SessionArgument,
    film: Annotated[Path, typer.Argument(help="Film: MP4, MOV, M4V, WebM, MKV or AVI.")],
    capture_rate: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Pictures per second when it was taken, if it plays at another rate.",
        ),
    ] = None,
    data: DataOption = None,
    as_json: JsonOption = False,
) -> None:
    """Copy a film to a session.

    It is read first: a file that no decoder can read is refused. A server may run at the same time.
    """
    from service.video.worker import check_extra_installed, describe_film
    from storage.durable_files import translate_storage_errors
    from storage.sessions.videos import IncomingVideo

    folder = _find_session_folder(session, data)
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
        while chunk := file.read(_CHUNK_BYTES):
            incoming.write(chunk)
        report_step(f"reading {film.name}")
        video = incoming.keep(lambda path: describe_film(path, str(film), capture_rate))
    if as_json:
        print_json(video.model_dump(mode="json"))
    else:
        echo(_format_video(video))


def video_list_command(
    session: SessionArgument, data: DataOption = None, as_json: JsonOption = False
) -> None:
    """List the films of a session, oldest first."""
    from storage.sessions.videos import read_videos

    videos, problems = read_videos(_find_session_folder(session, data))
    for problem in problems:
        remark(f"left out: {problem}")
    if as_json:
        print_json({"items": [video.model_dump(mode="json") for video in videos]})
        return
    for video in videos:
        echo(_format_video(video))


def video_remove_command(
    session: SessionArgument, video: VideoArgument, data: DataOption = None
) -> None:
    """Delete a film with its alignment and tables."""
    from storage.sessions.videos import remove_video

    remove_video(_find_session_folder(session, data), video)


@dataclass(frozen=True)
class MarkerOptions:
    """Options for two markers in the picture."""

    tags: Annotated[
        str | None,
        typer.Option(metavar="LOWER,UPPER", help="Numbers of two ArUco tags (4x4_50) on the leg."),
    ] = None
    dots: Annotated[
        str | None, typer.Option(help="Two dots along the leg: bright, or their colour.")
    ] = None
    area: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,WIDTH,HEIGHT",
            help="Part of the pictures in which the markers are, pixels from the left upper "
            "corner; default: all.",
        ),
    ] = None
    lens: Annotated[
        Path | None,
        typer.Option(help="Film of a checkerboard by the same camera, for its distortion."),
    ] = None
    board: Annotated[
        str, typer.Option(metavar="COLUMNSxROWS", help="Inner corners of the checkerboard.")
    ] = "9x6"

    @property
    def has_more(self) -> bool:
        """True if there are options beside the two that name markers."""
        return replace(self, tags=None, dots=None) != MarkerOptions()

    def to_values(self) -> dict[str, Any]:
        """Return them as arguments of `TrackOptions`.

        Raises:
            UsageError: a text is no list of sensible numbers.
        """
        tags = _parse_numbers(self.tags, "--tags", "3,7")
        if tags is not None and (max(tags) > _TAG_MAX or tags[0] == tags[1]):
            raise UsageError(f"--tags {self.tags}", expected=f"two numbers from 0 to {_TAG_MAX}")
        area_px = _parse_numbers(self.area, "--area", "400,0,600,1080")
        if area_px is not None and not min(area_px[2:]) > 0:
            raise UsageError(f"--area {self.area}", expected="a width and a height above 0")
        board = _parse_numbers(self.board, "--board", "9x6")
        if board is None or not min(board) >= 3 or not max(board) <= 100:
            raise UsageError(f"--board {self.board}", expected="3 to 100 inner corners")
        return {
            "tags": tags,
            "dots": self.dots,
            "area_px": area_px,
            "lens": self.lens,
            "board": board,
        }


@add_options
def video_align_command(
    session: SessionArgument,
    video: VideoArgument,
    by: Annotated[
        str,
        typer.Option(help="light (the node's lamp), clock (page /clock), contact or hand."),
    ],
    near: Annotated[
        float | None,
        typer.Option(
            min=-SECONDS_MAX,
            max=SECONDS_MAX,
            help="About when the film begins, seconds after the session's first frame.",
        ),
    ] = None,
    within: Annotated[
        float, typer.Option(min=0.0, max=SECONDS_MAX, help="Largest error of --near, seconds.")
    ] = NEAR_WITHIN_S,
    picture: Annotated[
        list[int] | None,
        typer.Option(
            metavar="N",
            help="By contact: first picture of a contact, from 0: the page's number less 1 (repeat "
            "for several); or name markers with --tags or --dots.",
        ),
    ] = None,
    pair: Annotated[
        list[str] | None,
        typer.Option(
            metavar="N=SECONDS",
            help="By hand: picture, from 0 (the page's number less 1), and its instant, seconds "
            "after the first frame (repeat for several).",
        ),
    ] = None,
    replaces: Annotated[
        bool, typer.Option("--replace", help="Replace an alignment that says otherwise.")
    ] = False,
    data: DataOption = None,
    as_json: JsonOption = False,
    *,
    markers: MarkerOptions,
) -> None:
    """Find a film's time in its session, with its uncertainty, and keep it beside the film."""
    from service.video.angle import TrackOptions
    from service.video.methods import AlignmentOptions, align_video
    from storage.formats.angle_table import SUFFIXES
    from storage.sessions.videos import AlignmentMethod, find_video_folder, read_video

    methods: dict[str, AlignmentMethod] = {each: each for each in get_args(AlignmentMethod)}
    if by not in methods:
        raise UsageError(f"--by {by}", expected=", ".join(methods))
    has_markers = markers.tags is not None or markers.dots is not None
    for option, is_used, is_right in (
        ("--picture is for --by contact", picture, by == "contact"),
        ("--pair is for --by hand", pair, by == "hand"),
        ("--near is for --by light and contact", near is not None, by in ("light", "contact")),
        ("--within is for --near", within != NEAR_WITHIN_S, near is not None),
        ("--tags and --dots are for --by contact", has_markers, by == "contact"),
        ("--area, --lens and --board are for --tags and --dots", markers.has_more, has_markers),
    ):
        if is_used and not is_right:
            raise UsageError(option)
    if by == "contact" and bool(picture) == has_markers:
        raise UsageError(
            "touchdowns are not named, or twice",
            expected="--picture of each, or markers of the foot by --tags or --dots",
        )
    pairs = [_parse_pair(text) for text in pair or []]
    options = AlignmentOptions(
        near_s=near,
        within_s=within,
        pictures=tuple(picture or [number for number, _ in pairs]),
        instants_s=tuple(instant_s for _, instant_s in pairs),
        track=TrackOptions(**markers.to_values()).make_task_options() if has_markers else None,
        replaces=replaces,
    )
    folder = _find_session_folder(session, data)
    facts = read_video(find_video_folder(folder, video))
    with show_progress_bar(f"aligning {facts.name}", facts.film.picture_count) as show_done:
        aligned = align_video(folder, video, methods[by], options, show_done)
    if as_json:
        print_json(aligned.model_dump(mode="json"))
    else:
        _report_alignment(folder, aligned)
    if any(path.suffix in SUFFIXES for path in find_video_folder(folder, video).iterdir()):
        remark(
            "t_ns and sigma_ns in tables of this video are by the alignment before; `foottile "
            "estimate --angle` takes the new one"
        )


@add_options
def video_track_command(
    session: SessionArgument,
    video: Annotated[
        str | None, typer.Argument(help="Id of the video; none for points in space.")
    ] = None,
    points: Annotated[
        str | None,
        typer.Option(metavar="LOWER,UPPER", help="Names of two points of --points-file."),
    ] = None,
    points_file: Annotated[
        Path | None,
        typer.Option(help="Points of another program: CSV of Kinovea or DeepLabCut, TRC, C3D."),
    ] = None,
    begin_s: Annotated[
        float | None,
        typer.Option(
            help="Without a video: begin of --points-file, seconds after the first frame."
        ),
    ] = None,
    forward: Annotated[
        str | None,
        typer.Option(help="The foot rolls to the right (default) or left; in space: x, -y."),
    ] = None,
    zero: Annotated[
        float, typer.Option(help="Angle of the markers, degrees, at which the foot's is 0.")
    ] = 0.0,
    scale: Annotated[
        float | None, typer.Option(help="Distance of the markers, mm; places are in m as well.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Table to write, .parquet or .csv; default: beside the film."
        ),
    ] = None,
    data: DataOption = None,
    as_json: JsonOption = False,
    *,
    markers: MarkerOptions,
) -> None:
    """Write the foot's angle in each picture as a table, for `foottile estimate --angle`."""
    from service.video.angle import TrackOptions, read_points_from, track_video
    from storage.formats.angle_table import ANGLE_NAME, SUFFIXES, check_suffix
    from storage.sessions.videos import find_video_folder, find_video_folders, read_video

    if [markers.tags, markers.dots, points_file].count(None) != 2:
        raise UsageError(
            "what to track is not clear", expected="one of --tags, --dots and --points-file"
        )
    if points_file is not None and markers.has_more:
        raise UsageError("--area, --lens and --board are for --tags and --dots")
    if (points is None) != (points_file is None):
        raise UsageError("--points are names in --points-file", expected="both or none")
    names = (points or ",").split(",")
    if len(names) != 2:
        raise UsageError(f"--points {points}", expected="LOWER,UPPER")
    if scale is not None and not 0.0 < scale < 1e5:
        raise UsageError(f"--scale {scale:g}", expected="millimetres, above 0")
    if not abs(zero) <= 360.0:
        raise UsageError(f"--zero {zero:g}", expected="degrees")
    options = TrackOptions(
        **markers.to_values(),
        points_file=points_file,
        points=(names[0].strip(), names[1].strip()),
        forward=forward,
        zero_rad=math.radians(zero),
        scale_m=None if scale is None else scale * 1e-3,
    )
    folder = _find_session_folder(session, data)
    inputs = [path for path in (points_file, markers.lens) if path is not None]
    # Of the session's files only tables beside a film may be written over.
    beside = find_video_folders(folder).values()
    inputs += [
        path
        for path in folder.rglob("*")
        if path.suffix not in SUFFIXES or path.parent not in beside
    ]
    if video is None:
        if points_file is None or out is None or begin_s is None:
            raise UsageError(
                "no video is named",
                expected="VIDEO; or --points-file, --begin-s and --out, of points in space",
            )
        check_suffix(out)
        path = resolve_output_path(out, *inputs)
        tracked = read_points_from(folder, options, begin_s)
    elif begin_s is not None:
        raise UsageError("--begin-s is for points in space", expected="no VIDEO, or no --begin-s")
    else:
        video_folder = find_video_folder(folder, video)
        path = out or video_folder / ANGLE_NAME
        check_suffix(path)
        path = resolve_output_path(path, *inputs)
        facts = read_video(video_folder)
        with show_progress_bar(f"tracking {facts.name}", facts.film.picture_count) as show_done:
            tracked = track_video(video_folder, facts, options, show_done)
    tracked.table.write(path, tracked.places)
    _report_track(path, tracked, as_json=as_json)


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


def _format_video(video: Video) -> str:
    film = video.film
    rate = f"{film.rate_hz:g} pictures/s" + (" (variable)" if film.is_variable else "")
    if film.capture_rate_hz is not None:
        rate += f" as taken, plays at {film.play_rate_hz:g}"
    if film.hidden_count:
        rate += f", trimmed ({film.hidden_count} pictures hidden)"
    aligned = "not aligned" if video.alignment is None else f"aligned by {video.alignment.method}"
    return (
        f"{video.id} {video.name}: {film.width_px} x {film.height_px}, {film.duration_s:.2f} s, "
        f"{film.picture_count} pictures, {rate}, {film.codec}, {video.size_bytes} bytes, {aligned}"
    )


def _report_alignment(session_folder: Path, video: Video) -> None:
    import numpy as np

    from service.video.session_time import read_session_time

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


def _report_track(path: Path, tracked: TrackedAngle, *, as_json: bool) -> None:
    import numpy as np

    table = tracked.table
    known = ~np.isnan(table.angle_rad)
    low, high = (float(f(table.angle_rad[known])) for f in (np.min, np.max))
    sigma_rad = float(np.median(table.sigma_rad[known]))
    is_aligned = table.t_ns is not None
    if as_json:
        print_json(
            {
                "out": path,
                "pictures": len(known),
                "with_angle": int(known.sum()),
                "angle_rad": [low, high],
                "sigma_rad": sigma_rad,
                "aligned": is_aligned,
            }
        )
        return
    echo(
        f"{path}: {int(known.sum())} of {len(known)} pictures have an angle, "
        f"{math.degrees(low):.1f} to {math.degrees(high):.1f} degrees, "
        f"+- {math.degrees(sigma_rad):.2g} (1 sigma)"
    )
    if not is_aligned:
        remark("the film is not aligned: `foottile video align` comes before `estimate --angle`")


def _parse_pair(text: str) -> tuple[int, float]:
    picture, _, seconds = text.partition("=")
    try:
        number, instant_s = int(picture), float(seconds)
    except ValueError:
        number, instant_s = -1, math.nan
    if not abs(instant_s) <= SECONDS_MAX:
        raise UsageError(f"--pair {text!r}", expected="a picture and its instant, as 120=3.52")
    return number, instant_s


def _parse_numbers(text: str | None, option: str, example: str) -> tuple[int, ...] | None:
    """Return as many whole numbers as an example has, with its separator; None for None."""
    if text is None:
        return None
    separator = "x" if "x" in example else ","
    parts = text.split(separator)
    if len(parts) != len(example.split(separator)) or not all(
        part.isascii() and part.isdecimal() and len(part) < 6 for part in parts
    ):
        raise UsageError(f"{option} {text!r}", expected=f"numbers, such as {example}")
    return tuple(map(int, parts))
