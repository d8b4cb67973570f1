"""Film in a file: its time stamps and pictures, read by PyAV.

Times are those of the container: presentation stamps, after edit lists, in rising order, whatever
the order in the file (B-frames). A stamp is the begin of display; the exposure may be earlier by a
constant, which the offset absorbs for light and contact, but not for the clock page.

A high-speed film that plays slowly, or a time-lapse film, states its capture rate in a tag of some
cameras, else the user does: times are then scaled by play rate / capture rate.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.errors import FileFormatError, UsageError, require_extra
from storage.sessions.videos import FilmInfo

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.stream import VideoStream

Picture = npt.NDArray[np.uint8]
"""Grey picture (height, width), or colours (height, width, 3) in the order blue, green, red."""

_CAPTURE_RATE_TAGS = ("com.android.capture.fps",)
"""Tags with the rate of a film that plays slower or, of time-lapse, faster than it was taken."""
_NORMAL_RATIO = 1.5
"""Ratio of a tagged rate to the played one up to which a film plays as it was taken.

Normal films of phones have the tag, too.
"""
_FASTEST_PART, _DROPPED_MAX = 0.02, 0.1
"""Part of the intervals that tells a film's fastest rate; greatest part that drops make longer."""
_CAPTURE_RATES_HZ = (1e-3, 1e6)
_GAP_BEYOND = 0.5
"""Intervals that differ by more than this part of their median do not count for the rate."""
_VARIABLE_BEYOND = 0.2
"""A film's rate is variable if an interval differs by more than this part of their median."""
_PIXELS_MAX = 8192 * 8192
_UNORDERED = ("h264", "hevc")
"""Codecs whose pictures the library cannot put in order where the file does not, as AVI."""
_ASPECT_RATIO_MAX = 4
"""A pixel that is wider or higher than so many times its other side is an error of the file."""
_PICTURES_MAX = 5_000_000
_THREADS = 4
_OPEN_OPTIONS = {
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi",
    "protocol_whitelist": "none",
}
"""Options that keep the library from playlists and descriptions that name files and addresses."""
_DURATION = re.compile(r"(\d{1,4}):(\d\d):(\d\d\.\d+)")
_MISSING_INTERVALS_MAX = 5.0
"""Longest part that may lack at the end, in the film's longest interval: it is shown longer."""


def read_film(path: Path, capture_rate_hz: float | None = None) -> tuple[FilmInfo, Floats]:
    """Read the facts of a film, and the time of each picture in s from the first.

    Only the first picture is decoded.

    Args:
        path: the film.
        capture_rate_hz: rate at which it was taken, if the file does not say it.

    Raises:
        FileFormatError: the file is no film, has no pictures, or is shorter than it says.
        UsageError: the rate is impossible.
    """
    with open_container(path) as (container, stream):
        stamps = _read_stamps(container, stream, path)
        times_s = np.asarray((stamps - stamps[0]) * float(stream.time_base or 1))
        _check_length(container, stream, times_s, path)
        tagged = _find_capture_rate_hz(container, stream)
        rotation_deg = _decode_rotation_deg(path)
        sideways = rotation_deg % 180 != 0
        width, height = _compute_shown_size_px(stream)
        codec = stream.codec_context.name
    play_rate_hz = _compute_rate_hz(times_s)
    if tagged is not None and _plays_as_taken(times_s, play_rate_hz, tagged):
        tagged = None
    captured_hz = tagged if capture_rate_hz is None else capture_rate_hz
    if captured_hz is not None:
        low, high = _CAPTURE_RATES_HZ
        if not (low <= captured_hz <= high) or not play_rate_hz:
            raise UsageError(
                f"the film cannot have been taken at {captured_hz:g} pictures/s",
                where=str(path),
                expected=f"a rate between {low:g} and {high:g}, and at least two pictures",
            )
        times_s = times_s * (play_rate_hz / captured_hz)
    rate_hz = _compute_rate_hz(times_s)
    return FilmInfo(
        codec=codec,
        width_px=height if sideways else width,
        height_px=width if sideways else height,
        rotation_deg=rotation_deg,
        picture_count=len(times_s),
        duration_s=float(times_s[-1]),
        rate_hz=rate_hz,
        play_rate_hz=play_rate_hz,
        is_variable=bool(_find_uneven(times_s, rate_hz).any()),
        capture_rate_hz=captured_hz,
    ), times_s


def _find_uneven(times_s: Floats, rate_hz: float) -> npt.NDArray[np.bool_]:
    """Return True for intervals that differ from the rate's."""
    return np.asarray(np.abs(np.diff(times_s) * rate_hz - 1.0) > _VARIABLE_BEYOND)


def _plays_as_taken(times_s: Floats, play_rate_hz: float, tagged_hz: float) -> bool:
    """Return True if a film with a tagged rate is no slow motion, and no time-lapse film.

    It has that rate, if only where there was light, or it has none, as by long exposures. Slow
    motion has its own, but for a few pictures that were dropped.
    """
    if not play_rate_hz:
        return True
    fastest_hz = 1.0 / float(np.quantile(np.diff(times_s), _FASTEST_PART))
    is_varying = _find_uneven(times_s, play_rate_hz).mean() > _DROPPED_MAX
    return bool(is_varying) or any(
        1 / _NORMAL_RATIO < tagged_hz / rate_hz < _NORMAL_RATIO
        for rate_hz in (play_rate_hz, fastest_hz)
    )


def _compute_rate_hz(times_s: Floats) -> float:
    """Compute pictures per second, without gaps; of one picture it is 0.

    It is no median: stamps of Matroska are rounded to milliseconds.
    """
    intervals_s = np.diff(times_s)
    if not len(intervals_s):
        return 0.0
    middle_s = np.sort(intervals_s)[len(intervals_s) // 2]  # one of them, unlike a median
    regular_s = intervals_s[np.abs(intervals_s / middle_s - 1.0) < _GAP_BEYOND]
    return 1.0 / float(regular_s.mean())


def iterate_pictures(
    path: Path, *, is_grey: bool, begin: int = 0, end: int | None = None
) -> Iterator[tuple[int, Picture]]:
    """Yield pictures of a film as shown, with their index in order of time.

    They are turned upright, and have square pixels.

    Args:
        path: the film.
        is_grey: True: brightness only.
        begin: index of the first picture; decoding begins at the key picture before it.
        end: index after the last one; None: the film's end.

    Raises:
        FileFormatError: the file is no film, or is damaged; pictures before are yielded.
    """
    import av

    with open_container(path) as (container, stream):
        stamps = _read_stamps(container, stream, path)
        width, height = _compute_shown_size_px(stream)
    end = len(stamps) if end is None else min(end, len(stamps))
    if begin >= end:
        return
    first, last = int(stamps[begin]), int(stamps[end - 1])
    pixel_format = "gray" if is_grey else "bgr24"
    shown = begin - 1
    # Before a cut of an edit list the library seeks too far: then all are decoded.
    for is_sought in (True, False) if begin else (False,):
        with open_container(path) as (container, stream):
            if is_sought:
                container.seek(first, stream=stream, backward=True)
            try:
                for frame in container.decode(stream):
                    if frame.pts is None or frame.pts < first:
                        continue
                    if is_sought and shown < begin and frame.pts > first:
                        break
                    if frame.pts > last:
                        return
                    shown = int(np.searchsorted(stamps, frame.pts))
                    shown_frame = frame.reformat(width=width, height=height, format=pixel_format)
                    picture = np.asarray(shown_frame.to_ndarray(), dtype=np.uint8)
                    yield shown, np.rot90(picture, round(frame.rotation / 90) % 4)
            except av.error.FFmpegError as error:
                raise FileFormatError(
                    f"the film breaks off after picture {shown}: {error.strerror}",
                    where=str(path),
                    remedy="Copy the file from the camera again",
                ) from error
        if shown >= begin:
            return


@contextmanager
def open_container(path: Path, **options: str) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open a film, and choose its pictures.

    Args:
        path: the film.
        options: of the library.

    Raises:
        FileFormatError: the file is no film, or its pictures cannot be decoded.
    """
    with require_extra("video", "a film"):
        import av
    if not path.is_file():
        raise FileFormatError("no such file", where=str(path), expected="a film")
    try:
        with (
            path.open("rb") as file,
            av.open(
                file, "r", options=_OPEN_OPTIONS | options, metadata_errors="replace"
            ) as container,
        ):
            if not container.streams.video:
                raise FileFormatError("the file has no pictures", where=str(path))
            # The first one may be a cover.
            stream = container.streams.best("video") or container.streams.video[0]
            assert isinstance(stream, av.VideoStream)  # noqa: S101
            if stream.codec_context is None:  # a drawing, or a codec that is not there
                raise FileFormatError("its pictures cannot be decoded", where=str(path))
            codec = stream.codec_context
            shown_px = math.prod(_compute_shown_size_px(stream))
            if max(shown_px, codec.width * codec.height) > _PIXELS_MAX:
                raise FileFormatError("its pictures are too large", where=str(path))
            if container.format.name == "avi" and codec.name in _UNORDERED and codec.has_b_frames:
                raise FileFormatError(
                    f"the order of its pictures is unknown: AVI with B-frames of {codec.name}",
                    where=str(path),
                    expected="MP4, MOV or MKV, which say when each picture is shown",
                    remedy="Copy it anew from the camera, as MP4, or convert it: "
                    "ffmpeg -i FILM.avi FILM.mp4",
                )
            stream.thread_type = "AUTO"
            stream.codec_context.thread_count = min(_THREADS, os.cpu_count() or 1)
            yield container, stream
    except (av.error.FFmpegError, OSError) as error:
        why = getattr(error, "strerror", None) or error
        raise FileFormatError(
            f"the file cannot be read as a film: {why}",
            where=str(path),
            expected="MP4, MOV, WebM, MKV or AVI",
            remedy="Play it, or copy it from the camera again",
        ) from error


def _compute_shown_size_px(stream: VideoStream) -> tuple[int, int]:
    """Return width and height of pictures with square pixels, before the rotation."""
    ratio = stream.sample_aspect_ratio
    if not ratio or not 1 / _ASPECT_RATIO_MAX <= ratio <= _ASPECT_RATIO_MAX:
        ratio = Fraction(1)
    return round(stream.codec_context.width * ratio), stream.codec_context.height


def _read_stamps(
    container: InputContainer, stream: VideoStream, path: Path
) -> npt.NDArray[np.int64]:
    """Read the different stamps of all pictures, rising, in the stream's time base."""
    stamps: list[int] = []
    packet_count = 0
    for packet in container.demux(stream):
        if not packet.size:
            continue
        packet_count += 1
        if packet_count > _PICTURES_MAX:
            raise FileFormatError(
                "the film is too long", where=str(path), expected=f"{_PICTURES_MAX} pictures"
            )
        # A file may have no times but those of decoding.
        stamp = packet.dts if packet.pts is None else packet.pts
        if stamp is not None and not packet.is_discard:
            stamps.append(stamp)
    if not stamps:
        raise FileFormatError("the film has no picture with a time", where=str(path))
    distinct = np.unique(np.array(stamps, dtype=np.int64))
    # As with a time scale of 0. Some films repeat a few instants; an edit list may hide pictures.
    count = max(packet_count, stream.frames)
    if len(distinct) == 1 < count or 2 * len(distinct) < len(stamps):
        raise FileFormatError(
            f"the film's {count} pictures are shown at {len(distinct)} instants: its "
            "header is damaged",
            where=str(path),
            expected="pictures one after the other",
            remedy="Copy the file from the camera again",
        )
    return distinct


def _check_length(
    container: InputContainer, stream: VideoStream, times_s: Floats, path: Path
) -> None:
    """Check that a film is as long as its header says, as a cut one opens, too.

    Matroska and AVI have no index of all pictures.
    """
    if "mp4" in container.format.name and len(times_s) < stream.frames:
        # A trimmed film has pictures that are not shown, but are in the file.
        with open_container(path, advanced_editlist="0") as (whole, pictures):
            packet_count = sum(packet.size > 0 for packet in whole.demux(pictures))
        if packet_count < stream.frames:
            raise FileFormatError(
                f"the film breaks off after {packet_count} of {stream.frames} pictures",
                where=str(path),
                remedy="Copy the file from the camera again",
            )
    stated_s = 0.0
    if found := _DURATION.fullmatch(stream.metadata.get("DURATION", "")):  # Matroska, WebM
        stated_s = int(found[1]) * 3600 + int(found[2]) * 60 + float(found[3])
    elif container.format.name == "avi" and stream.average_rate:
        stated_s = float(stream.frames / stream.average_rate)
    end_s = times_s[-1] + float((stream.start_time or 0) * (stream.time_base or 0))
    if stated_s - end_s > _MISSING_INTERVALS_MAX * np.max(np.diff(times_s), initial=0.0):
        raise FileFormatError(
            f"the film breaks off after {end_s:.2f} s of {stated_s:.2f} s",
            where=str(path),
            remedy="Copy the file from the camera again",
        )


def _find_capture_rate_hz(container: InputContainer, stream: VideoStream) -> float | None:
    tags: dict[str, Any] = {**container.metadata, **stream.metadata}
    for name in _CAPTURE_RATE_TAGS:
        try:
            rate_hz = float(tags[name])
        except (KeyError, ValueError):
            continue
        if math.isfinite(rate_hz) and rate_hz > 0:
            return rate_hz
    return None


def _decode_rotation_deg(path: Path) -> int:
    """Return the rotation of the first picture, which has to be decoded for it."""
    with open_container(path) as (container, stream):
        for frame in container.decode(stream):
            return round(frame.rotation / 90) * 90 % 360
    raise FileFormatError("its first picture cannot be decoded", where=str(path))
