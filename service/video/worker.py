"""Process that decodes a film, with limits: decoders crash, hang and take memory.

It gets a request as JSON on its standard input, and prints a line of JSON for each step: progress,
then the result or an error. It reads the film and writes nothing.
"""

from __future__ import annotations

import ctypes
import json
import math
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from devices.errors import FileFormatError, FootTileError, StateError, UsageError, require_extra
from storage.sessions.videos import FilmInfo

_CODE = "from service.video.worker import main; main()"
_TIMES_BEGIN = '{"film_s"'
"""Begin of the line with the times of all pictures, which is not parsed here."""
_PR_SET_PDEATHSIG = 1  # prctl.h
_MEMORY_BYTES_MAX = 4 << 30
_SILENT_S_MAX = 60.0
"""Longest time without a line: a film of 4K shows several pictures a second."""
_READ_BYTES_PER_S_MIN = 10e6
"""Rate of a slow disk, three passes without a line: a film's time stamps are all over its file."""
_PROGRESS_PICTURES = 50
_PART_PX = 16
"""Least size of the parts of a picture in which a lamp is looked for."""
_PARTS_MAX = 8192
_PARTS_BYTES_MAX = 1 << 30
_CLOCK_LOOK_S = 0.1
"""Interval of pictures in which a clock page is looked for."""
_ERRORS: dict[str, type[FootTileError]] = {
    kind.__name__: kind for kind in (FileFormatError, UsageError, StateError, FootTileError)
}


def check_extra_installed() -> None:
    """Check that films can be read, before one is copied.

    Raises:
        MissingExtraError: a package is not installed.
    """
    with require_extra("video", "a film"):
        for name in ("av", "cv2"):  # not imported: that is for the process of its own
            if find_spec(name) is None:
                raise ModuleNotFoundError(name=name)


def describe_film(
    path: Path, name: str, capture_rate_hz: float | None = None
) -> tuple[FilmInfo, bytes]:
    """Read the facts of a film, and check that its first and last pictures can be decoded.

    The times of its pictures stay text: parsing them would hold up a server's event loop.

    Args:
        path: the film.
        name: name for errors.
        capture_rate_hz: rate at which it was taken, if the file does not say it.

    Raises:
        FileFormatError: it is no film, or broken.
        UsageError: the rate is impossible.
        FootTileError: reading it failed by a bug.
    """
    try:
        found = run_film_task("read", path, capture_rate_hz=capture_rate_hz)
        return FilmInfo(**found["film"]), found["times_json"].encode()
    except FootTileError as error:
        error.what = error.what.replace(str(path), name)
        error.where = name
        raise


def run_film_task(
    task: str, path: Path, *, on_picture: Callable[[int], None] = lambda _: None, **options: Any
) -> dict[str, Any]:
    """Run a task on a film in a separate process, and return its result.

    Args:
        task: name in `_TASKS`.
        path: the film.
        on_picture: called with the number of pictures done.
        options: of the task.

    Raises:
        FileFormatError: the film cannot be decoded, or its decoder crashed or hung.
        FootTileError: of the task.
    """
    request = json.dumps({"task": task, "path": str(path), "options": options})
    try:
        silent_s_max = _SILENT_S_MAX + path.stat().st_size / _READ_BYTES_PER_S_MIN
    except OSError as error:
        raise FileFormatError(
            f"cannot be read: {error.strerror}", where=str(path), expected="a film"
        ) from error
    process = subprocess.Popen(  # noqa: S603  # our own module
        [sys.executable, "-P", "-c", _CODE],  # -P: no module of the working folder
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for the parent, which ends it
        text=True,
    )
    assert process.stdin is not None  # noqa: S101
    assert process.stdout is not None  # noqa: S101
    watchdog = threading.Timer(silent_s_max, process.kill)
    times_json = ""
    try:
        with suppress(BrokenPipeError):  # it has ended, and its code says how
            process.stdin.write(request)
            process.stdin.close()
        watchdog.start()
        for line in process.stdout:
            watchdog.cancel()
            watchdog = threading.Timer(silent_s_max, process.kill)
            watchdog.start()
            if line.startswith(_TIMES_BEGIN):
                times_json = line
                continue
            message: dict[str, Any] = json.loads(line)
            if "picture" in message:
                on_picture(message["picture"])
            elif "error" in message:
                facts = message["error"]
                raise _ERRORS[facts.pop("kind")](facts.pop("what"), **facts)
            else:
                result: dict[str, Any] = message["result"]
                return {**result, "times_json": times_json} if times_json else result
        code = process.wait()
        how = f"ended with {'signal' if code < 0 else 'code'} {abs(code)}"
        raise FileFormatError(
            f"its decoder {f'hung for {silent_s_max:g} s' if watchdog.finished.is_set() else how}",
            where=str(path),
            expected="a film that a player shows",
            remedy="Convert it, for example: ffmpeg -i FILM -c:v libx264 NEW.mp4",
        )
    finally:
        watchdog.cancel()
        process.kill()
        process.stdout.close()
        process.wait()


def main() -> None:
    """Run the task of the request on the standard input."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)  # no decoder outlives who waits
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES_MAX, _MEMORY_BYTES_MAX))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.nice(10)
    request = json.load(sys.stdin)
    try:
        _print({"result": _TASKS[request["task"]](Path(request["path"]), **request["options"])})
    except FootTileError as error:
        kind = next(name for name, k in _ERRORS.items() if isinstance(error, k))
        facts = {"where": error.where, "expected": error.expected, "remedy": error.remedy}
        known = {name: value for name, value in facts.items() if value}
        _print({"error": {"kind": kind, "what": error.what, **known}})
    except MemoryError:
        text = f"it needs more than {_MEMORY_BYTES_MAX >> 30} GiB"
        _print({"error": {"kind": "FileFormatError", "what": text, "where": request["path"]}})
    except Exception as error:  # a bug: the parent has no other way to know
        text = f"the task {request['task']} failed, which is a bug: {error!r}"
        _print({"error": {"kind": "FootTileError", "what": text, "where": request["path"]}})


def _print(message: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def _report(picture: int) -> None:
    if picture % _PROGRESS_PICTURES == 0:
        _print({"picture": picture})


def _read(path: Path, capture_rate_hz: float | None = None) -> dict[str, Any]:
    from service.video.container import iterate_pictures, read_film
    from service.video.edit_list import read_edit_list

    film, times_s = read_film(path, capture_rate_hz)
    _print({"picture": 0})
    edits = read_edit_list(path)
    _print({"picture": 0})
    last = film.picture_count - 1
    if last not in (index for index, _ in iterate_pictures(path, is_grey=True, begin=last)):
        raise FileFormatError(
            "the film's last picture cannot be decoded",
            where=str(path),
            remedy="Copy the file from the camera again",
        )
    whole = {} if edits.whole_s is None else {"whole_s": edits.whole_s.tolist()}
    _print({"film_s": times_s.tolist(), **whole})
    film = film.model_copy(update={"hidden_count": edits.hidden_count, "patch": edits.patch})
    return {"film": film.model_dump()}


def _find_lamp(
    path: Path, windows: list[tuple[float, float]], capture_rate_hz: float | None = None
) -> dict[str, Any]:
    import cv2

    from service.video.container import iterate_pictures, read_film
    from service.video.light import find_lamp

    film, times_s = read_film(path, capture_rate_hz)
    parts_max = min(_PARTS_MAX, _PARTS_BYTES_MAX / (2 * len(times_s)))
    part_px = max(_PART_PX, math.sqrt(film.width_px * film.height_px / parts_max))
    size = max(1, int(film.width_px / part_px)), max(1, int(film.height_px / part_px))
    # Half precision is a tenth of a step.
    rows = np.full((len(times_s), size[0] * size[1]), np.nan, dtype=np.float16)
    for index, picture in iterate_pictures(path, is_grey=True):
        small = cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        rows[index] = small.ravel()
        _report(index)
    seen = ~np.isnan(rows[:, 0])
    times_s, rows = times_s[seen], rows if seen.all() else rows[seen]

    def report_progress() -> None:
        _print({"picture": film.picture_count})

    found = [find_lamp(times_s, rows, *window, report_progress) for window in windows]
    return {"pairs": [[pair._asdict() for pair in pairs] for pairs in found]}


def _find_clock(path: Path, near_ns: int, capture_rate_hz: float | None = None) -> dict[str, Any]:
    from service.video.clock_page import ClockReading, find_clock_pairs, make_clock_reader
    from service.video.container import iterate_pictures, read_film

    _, times_s = read_film(path, capture_rate_hz)
    read = make_clock_reader()
    found: dict[int, ClockReading] = {}
    next_s = 0.0
    for index, picture in iterate_pictures(path, is_grey=True):
        _report(index)
        # Where there is no clock, a picture now and then is enough.
        if times_s[index] >= next_s:
            reading = read(picture)
            if reading is None:
                next_s = times_s[index] + _CLOCK_LOOK_S * (index - 1 not in found)
            else:
                found[index] = reading
    pairs = find_clock_pairs(times_s[list(found)], list(found.values()), near_ns)
    return {"pairs": [pair._asdict() for pair in pairs]}


def _track(
    path: Path,
    tags: tuple[int, int] | None = None,
    dots: str | None = None,
    area_px: tuple[int, int, int, int] | None = None,
    lens: str | None = None,
    board: tuple[int, int] = (0, 0),
    capture_rate_hz: float | None = None,
) -> dict[str, Any]:
    from service.video.container import read_film
    from service.video.tracking import (
        calibrate_lens,
        check_area,
        make_dot_finder,
        make_tag_finder,
        track_markers,
    )

    film, times_s = read_film(path, capture_rate_hz)
    if area_px is not None:
        check_area(area_px, film, path)

    def report_lens(_: int) -> None:
        _print({"picture": 0})  # the bar is that of the film

    places_px = track_markers(
        path,
        film,
        make_tag_finder(*tags) if tags is not None else make_dot_finder(dots or "", film),
        is_grey=tags is not None or dots == "bright",
        area_px=area_px,
        lens=None if lens is None else calibrate_lens(Path(lens), *board, film, report_lens),
        on_picture=_report,
    )
    return {"film_s": times_s.tolist(), "places_px": places_px.tolist()}


_TASKS: dict[str, Callable[..., dict[str, Any]]] = {
    "read": _read,
    "find_lamp": _find_lamp,
    "find_clock": _find_clock,
    "track": _track,
}
