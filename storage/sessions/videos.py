"""Videos of a session: a folder for each in the session's, whose other files they do not touch.

The file is kept as it came, under a fixed name. `video.json` states facts of the film, its hash,
and how its time is aligned with the session's. An incomplete folder has a temporary name. If its
process has ended, it is deleted when the next video is added, or a server starts.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import re
import secrets
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field

from devices.arrays import Floats, Times
from devices.clock import server_utc_ns
from devices.errors import (
    DamagedFileError,
    FileFormatError,
    StorageError,
    UnknownError,
    escape_control_chars,
)
from devices.types import Count, Identifier, StrictModel, Text, TNs
from storage.documents import read_document, write_document
from storage.durable_files import (
    is_dead_process_temporary,
    make_temporary_path,
    sync_folder,
    translate_storage_errors,
    write_atomically,
)
from storage.parquet_hash import compute_sha256

VIDEO_NAME, TIMES_NAME = "video.json", "times.json"
FILM_MEDIA_TYPES = {
    ".mp4": "video/mp4",
    ".mov": "video/quicktime",
    ".m4v": "video/mp4",
    ".webm": "video/webm",
    ".mkv": "video/x-matroska",
    ".avi": "video/x-msvideo",
}
"""Media types of films by suffix; other files are refused before anything is read."""
FREE_BYTES_MIN = 1 << 30
"""Space of the disk that films leave to frames."""
_VIDEO_ID = "[0-9a-f]{12}"
_FOLDER = re.compile(f"video-({_VIDEO_ID})")

Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
AlignmentMethod = Literal["light", "clock", "contact", "hand"]


DRIFT_SIGMA, CAPTURE_RATE_SIGMA = 50e-6, 1e-3
"""Standard deviations of a camera's drift beforehand: by its crystal; by a stated capture rate."""
LONE_PICTURE_S = 1.0
"""Interval of a film with one picture, whose rate is unknown: longer than any exposure of a foot's
film."""


class BytesPatch(StrictModel):
    """Bytes that replace others of a file."""

    at: Count
    """Where they begin in the file."""
    hex: Annotated[str, Field(pattern="^(?:[0-9a-f]{2})+$")]


class FilmInfo(StrictModel):
    """Facts of a film."""

    codec: Text
    width_px: Count
    height_px: Count
    """Both as shown: with square pixels, after the rotation."""
    rotation_deg: int
    """Rotation that a player applies, counterclockwise."""
    picture_count: Count
    duration_s: float
    """Time from the first picture to the last."""
    rate_hz: float
    """Pictures per second, without gaps."""
    play_rate_hz: float
    """Pictures per second as it plays: lower in slow motion."""
    is_variable: bool
    """True if intervals differ: a variable rate, or dropped pictures."""
    capture_rate_hz: float | None
    """Rate of taking, if the file plays at another rate: times are scaled to it."""
    hidden_count: Count | None = None
    """Pictures of the file that its edit list hides; null: which pictures browsers show is unknown,
    by an edit list that is not replaced, or of a film that was added before this was noted."""
    patch: BytesPatch | None = None
    """Bytes with which every browser shows all pictures of the file; null: all are the film's."""

    @property
    def drift_sigma(self) -> float:
        """Standard deviation of its clock's drift before anything is measured."""
        return DRIFT_SIGMA if self.capture_rate_hz is None else CAPTURE_RATE_SIGMA


class Alignment(StrictModel):
    """Line from the film's time to the session's, with the covariance of its two numbers."""

    method: AlignmentMethod
    film_s: float
    """Instant of the film at which the line is fixed, in s from its first picture."""
    t_ns: TNs
    """Instant of `film_s` in the session's time."""
    drift: float
    """Session's time per film's time, less one."""
    sigma_ns: float
    """Standard deviation of `t_ns`."""
    sigma_drift: float
    """Standard deviation of the drift, independent of that of `t_ns`."""
    pair_count: Count
    rejected_count: Count
    """Pairs that contradict the others."""

    def to_session_ns(self, film_s: Floats) -> Floats:
        """Convert instants of the film, in s from its first picture, to ns after `t_ns`."""
        return np.asarray((film_s - self.film_s) * (1e9 * (1.0 + self.drift)))

    def to_film_s(self, t_ns: Floats) -> Floats:
        """Convert instants in ns after `t_ns` to the film's, in s from its first picture."""
        return np.asarray(t_ns / (1e9 * (1.0 + self.drift)) + self.film_s)

    def place(self, film_s: Floats) -> tuple[Times, Floats]:
        """Convert instants of the film to the session's time, with their standard deviations."""
        t_ns = self.t_ns + np.rint(self.to_session_ns(film_s)).astype(np.int64)
        return t_ns, self.compute_sigma_ns(film_s)

    def compute_sigma_ns(self, film_s: Floats) -> Floats:
        """Compute the standard deviation of converted instants, in ns."""
        return np.asarray(
            np.hypot(self.sigma_ns, (film_s - self.film_s) * (1e9 * self.sigma_drift))
        )


class Video(StrictModel):
    """Video of a session, as `video.json` describes it."""

    id: Annotated[str, Field(pattern=f"^{_VIDEO_ID}$")]
    name: Identifier
    """Name of the file as it came."""
    suffix: Annotated[str, Field(pattern=r"^\.[a-z0-9]{3,4}$")]
    size_bytes: Count
    sha256: Sha256
    times_sha256: Sha256
    """SHA-256 of the file with the times of its pictures."""
    added_t_ns: TNs
    film: FilmInfo
    alignment: Alignment | None = None
    """None: its time is not known."""

    def place_pictures(self, film_s: Floats) -> tuple[Times, Floats] | tuple[None, None]:
        """Convert instants of its pictures to the session's time, with standard deviations, in ns.

        Rows of a picture are exposed one after the other, so that markers are not where the lamp
        is. None: it is not aligned.
        """
        if self.alignment is None:
            return None, None
        t_ns, sigma_ns = self.alignment.place(film_s)
        interval_s = 1.0 / self.film.rate_hz if self.film.rate_hz else LONE_PICTURE_S
        return t_ns, np.hypot(sigma_ns, 1e9 * interval_s / math.sqrt(12.0))


def find_video_folders(session_folder: Path) -> dict[str, Path]:
    """Return the folders of a session's videos by id, sorted.

    Raises:
        StorageError: they cannot be listed now.
    """
    try:
        names = sorted(os.listdir(session_folder))
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise StorageError(
            f"cannot be read: {error.strerror}", where=str(session_folder), errno=error.errno
        ) from error
    found = ((_FOLDER.fullmatch(name), session_folder / name) for name in names)
    return {match[1]: path for match, path in found if match and not path.is_symlink()}


def find_video_folder(session_folder: Path, video_id: str) -> Path:
    """Return the folder of one video.

    Raises:
        UnknownError: there is none with this id.
        StorageError: they cannot be listed now.
    """
    found = find_video_folders(session_folder)
    if video_id not in found:
        raise UnknownError(
            f"the session has no video {video_id[:80]!r}",
            expected=", ".join(found) or "a video: it has none",
        )
    return found[video_id]


def read_video(folder: Path) -> Video:
    """Read the description of a video.

    Raises:
        UnknownError: the video was removed.
        DamagedFileError: the description is missing, or was changed.
        FileFormatError: it is of another version.
        StorageError: it cannot be read now.
    """
    try:
        return read_document(folder / VIDEO_NAME, Video)
    except FileNotFoundError as error:
        if not folder.exists():
            raise UnknownError("the video was removed", where=str(folder)) from error
        raise DamagedFileError("the video has no description", where=str(folder)) from error


def read_videos(session_folder: Path) -> tuple[list[Video], list[str]]:
    """Read the descriptions of all videos of a session, oldest first; and problems as text."""
    videos, problems = list[Video](), list[str]()
    for folder in find_video_folders(session_folder).values():
        try:
            videos.append(read_video(folder))
        except UnknownError:
            continue  # removed meanwhile
        except (FileFormatError, StorageError) as error:
            problems.append(str(error))
    return sorted(videos, key=lambda video: video.added_t_ns), problems


def get_film_path(folder: Path, video: Video) -> Path:
    """Return the path of a video's file."""
    return folder / f"film{video.suffix}"


def read_picture_times(folder: Path) -> Floats:
    """Read the times of a film's pictures, in s from the first.

    Raises:
        DamagedFileError: they are missing, or were changed.
    """
    path = folder / TIMES_NAME
    try:
        return np.asarray(json.loads(path.read_bytes())["film_s"], dtype=np.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DamagedFileError(
            f"the times of its pictures cannot be read: {error}",
            where=str(path),
            remedy="Add the film again",
        ) from error


def write_video(folder: Path, video: Video) -> None:
    """Write the description of a video; an existing one is replaced.

    Raises:
        StorageError: the disk is full or not writable.
    """
    write_document(folder / VIDEO_NAME, video)


class IncomingVideo:
    """Video whose file is being written; as a context manager it is deleted unless it is kept.

    Args:
        session_folder: folder of the session.
        name: name of the file as it came; only shown.
        size_bytes: its size, if known: a file that does not fit is refused before it is written.

    Raises:
        FileFormatError: films do not end so.
    """

    def __init__(self, session_folder: Path, name: str, size_bytes: int = 0) -> None:
        self.name = escape_control_chars(Path(name).name)[-200:]
        self._suffix = Path(self.name).suffix.lower()
        if self._suffix not in FILM_MEDIA_TYPES:
            raise FileFormatError(
                f"{self.name!r} is no film", expected=f"a file in {', '.join(FILM_MEDIA_TYPES)}"
            )
        self._id = secrets.token_hex(6)
        self._final = session_folder / f"video-{self._id}"
        self._folder = make_temporary_path(self._final)
        self._path = self._folder / f"film{self._suffix}"
        self._size_bytes = size_bytes
        self._hash = hashlib.sha256()

    def __enter__(self) -> Self:
        """Create the file; delete what ended processes left of others.

        Raises:
            UnknownError: the session was deleted meanwhile.
            StorageError: it cannot be created, or does not fit.
        """
        for path in self._final.parent.glob(".video-*.tmp"):
            if is_dead_process_temporary(path.name):
                shutil.rmtree(path, ignore_errors=True)
        _check_space(self._final.parent, self._size_bytes)
        with translate_storage_errors(self._final.parent):
            # Whoever may not read the session may not see its film, whatever the umask.
            self._folder.mkdir(mode=self._final.parent.stat().st_mode & 0o777)
            try:
                self._file = open(self._path, "wb")
            except OSError:
                self._folder.rmdir()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file; delete it unless it was kept."""
        with suppress(OSError):  # what could not be written
            self._file.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def write(self, *pieces: bytes) -> None:
        """Append to the file, and wait for the disk: a backlog would delay the sync of journals.

        Raises:
            UnknownError: the session was deleted meanwhile.
            StorageError: the disk is not writable, or would have too little space left.
        """
        with translate_storage_errors(self._path):
            _check_space(self._folder, sum(map(len, pieces)))
            for piece in pieces:
                self._file.write(piece)
                self._hash.update(piece)
            self._file.flush()
            os.fdatasync(self._file.fileno())

    def keep(self, describe: Callable[[Path], tuple[FilmInfo, bytes]]) -> Video:
        """Describe the film that is now complete, and put the video in place.

        Args:
            describe: reads a film and the times of its pictures, JSON with `film_s`, in a separate
                process; raises if it is none.

        Raises:
            UnknownError: the session was deleted meanwhile.
            StorageError: the disk is full or not writable.
        """
        film, times_json = describe(self._path)
        video = Video(
            id=self._id,
            name=self.name,
            suffix=self._suffix,
            size_bytes=self._file.tell(),
            sha256=self._hash.hexdigest(),
            added_t_ns=server_utc_ns(),
            film=film,
            times_sha256=hashlib.sha256(times_json).hexdigest(),
        )
        _check_space(self._folder, len(times_json))
        write_atomically(self._folder / TIMES_NAME, times_json)
        write_video(self._folder, video)
        with translate_storage_errors(self._final):
            self._folder.rename(self._final)
            sync_folder(self._final.parent)
        return video


def _check_space(folder: Path, size_bytes: int) -> None:
    """Check that the folder is there, and that this much fits on its disk.

    Raises:
        UnknownError: the session was moved or deleted.
        StorageError: less than `FREE_BYTES_MIN` would be left.
    """
    with translate_storage_errors(folder):
        try:
            disk = os.statvfs(folder)
        except FileNotFoundError as error:
            raise UnknownError("the session was deleted meanwhile", where=str(folder)) from error
    if disk.f_bavail * disk.f_frsize < FREE_BYTES_MIN + size_bytes:
        raise StorageError(
            f"no space for the film: {FREE_BYTES_MIN >> 20} MiB of the disk stay free for frames",
            where=str(folder),
            remedy="Free space on the disk",
            errno=errno.ENOSPC,
        )


def remove_video(session_folder: Path, video_id: str) -> None:
    """Delete a video with its alignment and tables.

    Raises:
        UnknownError: there is none with this id.
        StorageError: it cannot be deleted.
    """
    folder = find_video_folder(session_folder, video_id)
    doomed = make_temporary_path(folder)
    with translate_storage_errors(folder):
        folder.rename(doomed)  # at once, for all readers
        sync_folder(session_folder)
        shutil.rmtree(doomed)


def verify_videos(session_folder: Path) -> list[str]:
    """Verify the files of a session's videos by their hashes; return problems as text."""
    problems = []
    for video_id, folder in find_video_folders(session_folder).items():
        try:
            video = read_video(folder)
            path = get_film_path(folder, video)
            if path.stat().st_size != video.size_bytes:
                what = f"has {path.stat().st_size} bytes, not {video.size_bytes}"
            elif compute_sha256(path) != video.sha256:
                what = "was changed: its SHA-256 is another one"
            elif compute_sha256(folder / TIMES_NAME) != video.times_sha256:
                what = f"has another {TIMES_NAME}: its SHA-256 is another one"
            else:
                continue
            problems.append(f"video {video_id}: {video.name} {what}")
        except UnknownError:
            continue  # removed meanwhile
        except FileNotFoundError:
            if folder.exists():
                problems.append(f"video {video_id}: {video.name} is missing")
        except (FileFormatError, OSError) as error:
            problems.append(f"video {video_id}: {getattr(error, 'what', error)}")
    return problems
