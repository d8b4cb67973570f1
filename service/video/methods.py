"""Methods of alignment: each finds instants of a film in its session, as pairs for one line.

One that contradicts the stored alignment by another method is not stored unless it shall replace
that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError, StateError, UsageError
from devices.lamp_code import BIT_NS, CODE_BITS, LAMP_LATE_NS
from service.video.alignment import (
    Instants,
    describe_contradiction,
    fit_alignment,
    match_contacts,
)
from service.video.contact import find_touchdowns
from service.video.session_time import SessionTime, read_session_time
from service.video.worker import run_film_task
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.time_axis import PartSpan
from storage.sessions.videos import (
    LONE_PICTURE_S,
    Alignment,
    AlignmentMethod,
    Video,
    find_video_folder,
    get_film_path,
    read_picture_times,
    read_video,
    write_video,
)

COMMON_PART = 0.5
"""Part of the uncertainty of touchdowns and of instants that a person chose, which all instants of
a film share: ground and person are the same."""
PICK_SIGMA = 1.0 / math.sqrt(3.0)
"""Standard deviation of a picture that a person chose, in intervals: one too early or too late."""
_LAMP_MARGIN_NS = 3_000_000_000
"""Time around a part in which its lamp's window may have its middle: half a window."""
_LAMP_AMBIGUOUS_NS = 1e9
"""Difference of two pairs of a film that is no drift: they are of different times."""


@dataclass(frozen=True)
class AlignmentOptions:
    """Options of the methods.

    Attributes:
        near_s: about when the film begins, in s after the session's begin.
        within_s: largest error of `near_s`.
        pictures: pictures that a person chose: of touchdowns, or by hand.
        instants_s: their instants in s after the session's begin, by hand.
        track: options of the task that tracks the foot's markers, by contact without pictures.
        replaces: True: an alignment by another method that it contradicts is replaced.
    """

    near_s: float | None = None
    within_s: float = 5.0
    pictures: tuple[int, ...] = ()
    instants_s: tuple[float, ...] = ()
    track: dict[str, Any] | None = None
    replaces: bool = False


class _Pairs(NamedTuple):
    """Pairs as arguments of `fit_alignment`."""

    film_s: Floats
    t_ns: Floats
    sigma_ns: Floats
    common_ns: float = 0.0


@dataclass(frozen=True)
class _Film:
    """Film that is being aligned."""

    video: Video
    path: Path
    on_picture: Callable[[int], None]

    def run(self, task: str, **options: Any) -> dict[str, Any]:
        """Run a task on the film in a separate process."""
        rate_hz = self.video.film.capture_rate_hz
        return run_film_task(
            task, self.path, on_picture=self.on_picture, capture_rate_hz=rate_hz, **options
        )

    def find_pictures(self, pictures: Sequence[int]) -> tuple[Floats, Floats]:
        """Return the times of pictures, and the intervals from those before them, in s.

        Raises:
            UsageError: the film has no such picture.
        """
        count = self.video.film.picture_count
        if not pictures or not all(0 <= picture < count for picture in pictures):
            raise UsageError(
                f"pictures {', '.join(map(str, pictures)) or 'are missing'}",
                where=self.video.name,
                expected=f"numbers from 0 to {count - 1}",
            )
        times_s = read_picture_times(self.path.parent)
        intervals_s = np.diff(times_s) if count > 1 else np.array([LONE_PICTURE_S])
        rows = np.array(pictures)
        return times_s[rows], intervals_s[np.maximum(rows - 1, 0)]


def align_video(
    session_folder: Path,
    video_id: str,
    method: AlignmentMethod,
    options: AlignmentOptions = AlignmentOptions(),
    on_picture: Callable[[int], None] = lambda _: None,
) -> Video:
    """Align a video with its session, and store the alignment.

    Args:
        session_folder: folder of the sealed session.
        video_id: id of the video.
        method: how the instants are found.
        options: options of the method.
        on_picture: called with the number of pictures done.

    Raises:
        UnknownError: no such video, or the session has no estimates.
        FileFormatError: no instant is found, or they do not agree.
        StateError: it contradicts that by another method, or the server's time is unknown.
        UsageError: an option is missing, or does not fit the method.
        StorageError: the alignment cannot be written.
    """
    folder = find_video_folder(session_folder, video_id)
    video = read_video(folder)
    film = _Film(video, get_film_path(folder, video), on_picture)
    time = read_session_time(session_folder / FRAMES_NAME)
    pairs = _METHODS[method](film, time, options)
    alignment = fit_alignment(
        method,
        pairs.film_s,
        pairs.t_ns,
        pairs.sigma_ns,
        begin_t_ns=time.begin_t_ns,
        common_ns=pairs.common_ns,
        drift_sigma=film.video.film.drift_sigma,
    )
    return store_alignment(folder, alignment, replaces=options.replaces)


def store_alignment(folder: Path, alignment: Alignment, *, replaces: bool) -> Video:
    """Store a video's alignment.

    Args:
        folder: folder of the video.
        alignment: the alignment.
        replaces: True: one by another method that it contradicts is replaced.

    Raises:
        FileFormatError: by it, film and session have no instant in common.
        StateError: it contradicts the stored one, by another method.
        StorageError: it cannot be written.
    """
    video = read_video(folder)
    _check_overlap(video, alignment, read_session_time(folder.parent / FRAMES_NAME))
    stored = video.alignment
    if stored is not None and stored.method != alignment.method and not replaces:
        problem = describe_contradiction(stored, alignment)
        if problem:
            raise StateError(
                problem,
                where=video.name,
                expected="methods that agree",
                remedy="Find out which is wrong; the new one may replace the stored one",
            )
    aligned = video.model_copy(update={"alignment": alignment})
    write_video(folder, aligned)
    return aligned


def _check_overlap(video: Video, alignment: Alignment, time: SessionTime) -> None:
    """Check that film and session have an instant in common.

    Raises:
        FileFormatError: they have none.
    """
    ends_s = np.array([0.0, video.film.duration_s])
    begin_ns, end_ns = (alignment.t_ns + alignment.to_session_ns(ends_s).astype(np.int64)).tolist()
    early_s, late_s = 1e-9 * (time.begin_t_ns - end_ns), 1e-9 * (begin_ns - time.end_t_ns)
    if early_s > 0 or late_s > 0:
        where = f"ends {early_s:.1f} s before" if early_s > 0 else f"begins {late_s:.1f} s after"
        raise FileFormatError(
            f"by {alignment.method} the film {where} the session",
            where=video.name,
            expected="a film of this session",
            remedy="Add it to the session that was recorded meanwhile",
        )


def _pair_by_light(film: _Film, time: SessionTime, options: AlignmentOptions) -> _Pairs:
    if not time.has_lamp:
        raise UsageError(
            "the node had no lamp in this session",
            where=str(time.path.parent),
            expected='output = "code" in [sync] of its scene',
            remedy="Align by clock, contact or hand",
        )
    spans, windows = list[PartSpan](), list[tuple[int, int]]()
    for span in time.spans:
        begin_ns = span.t_mono_ns[0] - round(1e9 * film.video.film.duration_s)
        end_ns = span.t_mono_ns[1]
        if options.near_s is not None:
            near_ns = time.begin_t_ns + round(1e9 * options.near_s) - time.get_mono_offset_ns(span)
            begin_ns = max(begin_ns, near_ns - round(1e9 * options.within_s))
            end_ns = min(end_ns, near_ns + round(1e9 * options.within_s))
        if begin_ns <= end_ns:
            spans.append(span)
            windows.append((begin_ns, end_ns))
    if not windows:
        raise UsageError(
            f"--near {options.near_s:g} is outside the session",
            where=film.video.name,
            expected="seconds from the session's begin to that of the film",
        )
    if max(end_ns - begin_ns for begin_ns, end_ns in windows) > CODE_BITS * BIT_NS:
        raise _make_ambiguity_error(film)
    found: dict[float, tuple[float, float, float]] = {}
    for span, pairs in zip(spans, film.run("find_lamp", windows=windows)["pairs"], strict=True):
        first_ns, last_ns = span.t_mono_ns
        to_session_ns = time.get_mono_offset_ns(span) - time.begin_t_ns
        for pair in pairs:
            t_mono_ns = pair["t_mono_ns"]
            if first_ns - _LAMP_MARGIN_NS <= t_mono_ns <= last_ns + _LAMP_MARGIN_NS:
                row = pair["correlation"], t_mono_ns + to_session_ns, pair["sigma_ns"]
                found[pair["film_s"]] = max(row, found.get(pair["film_s"], row))
    if not found:
        raise FileFormatError(
            "no part of the picture blinks the lamp's code",
            where=film.video.name,
            expected="the node's lamp in the picture for at least 6 s while it records",
            remedy="Look for it in the film, or align by clock, contact or hand",
        )
    film_s = np.array(sorted(found))
    _, t_ns, sigma_ns = np.array([found[each] for each in film_s]).T
    if np.any(np.abs(np.diff(t_ns) - 1e9 * np.diff(film_s)) > _LAMP_AMBIGUOUS_NS):
        raise _make_ambiguity_error(film)
    # A switch is late, never early.
    late_ns = LAMP_LATE_NS / 2.0
    return _Pairs(film_s, t_ns + late_ns, sigma_ns, late_ns / math.sqrt(3.0))


def _make_ambiguity_error(film: _Film) -> FileFormatError:
    return FileFormatError(
        "the lamp's code fits at more than one time of the session: it starts anew with the node's "
        "machine, and after 27 hours",
        where=film.video.name,
        remedy="Say about when the film begins with --near",
    )


def _pair_by_clock_page(film: _Film, time: SessionTime, _: AlignmentOptions) -> _Pairs:
    pairs = film.run("find_clock", near_ns=time.get_any_server_time())["pairs"]
    if not pairs:
        raise FileFormatError(
            "no picture shows the clock page",
            where=film.video.name,
            expected="the page /clock of this server, whole and sharp, for two seconds",
            remedy="Look for it in the film; one that plays slower needs --capture-rate when added",
        )
    rows = [time.convert_server_time(pair["t_ns"]) for pair in pairs]
    return _Pairs(
        film_s=np.array([pair["film_s"] for pair in pairs]),
        t_ns=np.array([t_ns - time.begin_t_ns for t_ns, _ in rows], dtype=np.float64),
        sigma_ns=np.array([pair["sigma_ns"] for pair in pairs]),
        common_ns=max(
            math.hypot(pair["common_ns"], bound_ns / math.sqrt(3.0))
            for pair, (_, bound_ns) in zip(pairs, rows, strict=True)
        ),
    )


def compute_common_ns(sigma_ns: Floats) -> float:
    """Compute the standard deviation that touchdowns or chosen instants share, from their own."""
    return COMMON_PART * float(np.median(sigma_ns))


def _pair_by_contact(film: _Film, time: SessionTime, options: AlignmentOptions) -> _Pairs:
    if options.track is not None:
        track = film.run("track", **options.track)
        height_px = -np.array(track["places_px"])[:, 0, 1]
        found = find_touchdowns(np.array(track["film_s"]), height_px)
        at_s, sigma_s = np.array(found, dtype=np.float64).reshape(-1, 2).T
    else:
        shown_s, interval_s = film.find_pictures(sorted(set(options.pictures)))
        if 0 in options.pictures:
            raise UsageError(
                "picture 0 shows no touchdown: it may have been before the film",
                where=film.video.name,
                expected="the first picture of a contact, behind one of the foot in the air",
            )
        # The foot was put down between the picture before and the first one.
        at_s, sigma_s = shown_s - interval_s / 2.0, interval_s * PICK_SIGMA
    near_s = (-math.inf, math.inf)
    if options.near_s is not None:
        near_s = options.near_s - options.within_s, options.near_s + options.within_s
    contacts = time.load_contacts()
    pairs = match_contacts(
        Instants(
            *(at_s, sigma_s, film.video.film.duration_s, film.video.film.drift_sigma),
            is_complete=options.track is not None,
        ),
        contacts,
        near_s,
    )
    rows, numbers = np.array(pairs).T
    return _Pairs(
        film_s=at_s[rows],
        t_ns=1e9 * contacts.at_s[numbers],
        sigma_ns=1e9 * np.hypot(sigma_s[rows], contacts.sigma_s[numbers]),
        common_ns=compute_common_ns(1e9 * sigma_s[rows]),
    )


def _pair_by_hand(film: _Film, time: SessionTime, options: AlignmentOptions) -> _Pairs:
    if len(options.instants_s) != len(options.pictures):
        raise UsageError("by hand each picture needs its instant", where=film.video.name)
    film_s, interval_s = film.find_pictures(options.pictures)
    sigma_ns = np.hypot(1e9 * PICK_SIGMA * interval_s, time.period_ns / math.sqrt(12.0))
    return _Pairs(
        film_s=film_s,
        t_ns=1e9 * np.array(options.instants_s),
        sigma_ns=sigma_ns,
        common_ns=compute_common_ns(sigma_ns),
    )


_METHODS: dict[AlignmentMethod, Callable[[_Film, SessionTime, AlignmentOptions], _Pairs]] = {
    "light": _pair_by_light,
    "clock": _pair_by_clock_page,
    "contact": _pair_by_contact,
    "hand": _pair_by_hand,
}
