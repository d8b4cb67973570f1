"""Options of `foottile video track`, and its report."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devices.errors import UsageError
from service.cli.options import echo, print_json, remark, resolve_output_path, show_progress_bar

if TYPE_CHECKING:
    from service.video.angle import TrackedAngle, TrackOptions


@dataclass(frozen=True)
class TrackArguments:
    """Options of `foottile video track`."""

    tags: Annotated[
        str | None,
        typer.Option(
            metavar="LOWER,UPPER", help="track: numbers of two ArUco tags (4x4_50) along the leg."
        ),
    ] = None
    dots: Annotated[
        str | None, typer.Option(help="track: two dots along the leg: bright, or their colour.")
    ] = None
    points: Annotated[
        str | None,
        typer.Option(metavar="LOWER,UPPER", help="track: names of two points of --points-file."),
    ] = None
    points_file: Annotated[
        Path | None,
        typer.Option(
            help="track: what another program tracked: CSV of Kinovea or DeepLabCut, TRC, C3D."
        ),
    ] = None
    begin_s: Annotated[
        float | None,
        typer.Option(
            help="track: without a video: begin of --points-file, seconds after the first frame."
        ),
    ] = None
    forward: Annotated[
        str | None,
        typer.Option(help="track: the foot rolls to the right (default) or left; in space: x, -y."),
    ] = None
    zero: Annotated[
        float, typer.Option(help="track: angle of the markers, degrees, at which the foot's is 0.")
    ] = 0.0
    scale: Annotated[
        float | None,
        typer.Option(help="track: distance of the markers, mm; places are in m as well."),
    ] = None
    lens: Annotated[
        Path | None,
        typer.Option(help="track: film of a checkerboard by the same camera, for its distortion."),
    ] = None
    board: Annotated[
        str, typer.Option(metavar="COLUMNSxROWS", help="track: inner corners of the checkerboard.")
    ] = "9x6"
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="track: table to write, .parquet or .csv; default: beside the film."
        ),
    ] = None

    def make_options(self) -> TrackOptions:
        """Return the options as values.

        Raises:
            UsageError: they do not fit together, or are no numbers.
        """
        from service.video.angle import TrackOptions

        if [self.tags, self.dots, self.points_file].count(None) != 2:
            raise UsageError(
                "what to track is not clear", expected="one of --tags, --dots and --points-file"
            )
        if (self.points is None) != (self.points_file is None):
            raise UsageError("--points are names in --points-file", expected="both or none")
        tags = None if self.tags is None else _parse_two(self.tags, ",", "--tags", "3,7")
        if tags is not None and (max(tags) > 49 or tags[0] == tags[1]):
            raise UsageError(f"--tags {self.tags}", expected="two numbers from 0 to 49")
        board = _parse_two(self.board, "x", "--board", "9x6")
        if not min(board) >= 3 or not max(board) <= 100:
            raise UsageError(f"--board {self.board}", expected="3 to 100 inner corners")
        names = (self.points or ",").split(",")
        if len(names) != 2:
            raise UsageError(f"--points {self.points}", expected="LOWER,UPPER")
        if self.scale is not None and not 0.0 < self.scale < 1e5:
            raise UsageError(f"--scale {self.scale:g}", expected="millimetres, above 0")
        if not abs(self.zero) <= 360.0:
            raise UsageError(f"--zero {self.zero:g}", expected="degrees")
        return TrackOptions(
            tags=tags,
            dots=self.dots,
            lens=self.lens,
            board=board,
            points_file=self.points_file,
            points=(names[0].strip(), names[1].strip()),
            forward=self.forward,
            zero_rad=math.radians(self.zero),
            scale_m=None if self.scale is None else self.scale * 1e-3,
        )


def _parse_two(text: str, separator: str, option: str, example: str) -> tuple[int, int]:
    parts = text.split(separator)
    if len(parts) != 2 or not all(part.isdecimal() and len(part) < 4 for part in parts):
        raise UsageError(f"{option} {text!r}", expected=f"two numbers, such as {example}")
    return int(parts[0]), int(parts[1])


def track_angle(
    session_folder: Path, video_id: str | None, arguments: TrackArguments, *, as_json: bool
) -> None:
    """Write the table of a video's angle, and report it.

    Raises:
        FootTileError: the video or the file of points is not usable, or the options do not fit.
    """
    from service.video.angle import read_points_from, track_video
    from storage.formats.angle_table import ANGLE_NAME, check_suffix
    from storage.sessions.videos import find_video_folder, read_video

    options = arguments.make_options()
    inputs = [path for path in (options.points_file, options.lens) if path is not None]
    if video_id is None:
        if options.points_file is None or arguments.out is None or arguments.begin_s is None:
            raise UsageError(
                "no video is named",
                expected="VIDEO; or --points-file, --begin-s and --out, of points in space",
            )
        check_suffix(arguments.out)
        path = resolve_output_path(arguments.out, *inputs)
        tracked = read_points_from(session_folder, options, arguments.begin_s)
    else:
        folder = find_video_folder(session_folder, video_id)
        out = arguments.out or folder / ANGLE_NAME
        check_suffix(out)
        path = resolve_output_path(out, *inputs)
        video = read_video(folder)
        with show_progress_bar(f"tracking {video.name}", video.film.picture_count) as show_done:
            tracked = track_video(folder, video, options, show_done)
    tracked.table.write(path, tracked.places)
    _report(path, tracked, as_json=as_json)


def _report(path: Path, tracked: TrackedAngle, *, as_json: bool) -> None:
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
