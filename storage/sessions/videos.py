"""Videos of a session: a folder for each, beside the session's frames, which they do not touch.

The file is kept as it came, under a fixed name. `video.json` says what it is, with its hash, and
how its time is aligned with the session's. A folder's name is drawn, so it is looked up in the
listing and never made into a path.
"""

from __future__ import annotations

import re
import secrets
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from devices.arrays import Floats
from devices.errors import DamagedFileError, FileFormatError, StorageError, UnknownError
from devices.types import Count, Identifier, StrictModel, Text, TNs
from storage.documents import read_document, write_document
from storage.durable_files import (
    make_synced_folder,
    open_for_atomic_write,
    sync_folder,
    translate_storage_errors,
)
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import DELETED_PREFIX

VIDEOS_FOLDER = "videos"
VIDEO_NAME = "video.json"
FILM_STEM = "film"
SUFFIXES = (".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi")
"""Suffixes of films; others are refused before anything is read."""
_VIDEO_ID = re.compile(r"[0-9a-f]{12}")

AlignmentMethod = Literal["light", "clock page", "contact", "hand"]


class FilmInfo(StrictModel):
    """What a film is."""

    codec: Text
    width_px: Count
    height_px: Count
    """Both as shown: after the rotation."""
    rotation_deg: int
    """Rotation that a player applies, counterclockwise."""
    picture_count: Count
    duration_s: float
    """Time from the first picture to the last."""
    rate_hz: float
    """Pictures per second: the inverse of their median interval."""
    is_variable: bool
    """True if intervals differ: a variable rate, or dropped pictures."""
    capture_rate_hz: float | None
    """Rate at which it was taken, if it plays at another one; stamps are shortened by it."""


class Alignment(StrictModel):
    """Line from the film's time to the session's, with the covariance of its two numbers."""

    method: AlignmentMethod
    film_s: float
    """Instant of the film at which the line is fixed, in s from its first picture."""
    t_ns: TNs
    """The same instant in the session's time."""
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

    def compute_sigma_ns(self, film_s: Floats) -> Floats:
        """Compute the standard deviation of converted instants, in ns."""
        return np.asarray(
            np.hypot(self.sigma_ns, (film_s - self.film_s) * (1e9 * self.sigma_drift))
        )


class Video(StrictModel):
    """Video of a session, as `video.json` describes it."""

    id: Annotated[str, Field(pattern=f"^{_VIDEO_ID.pattern}$")]
    name: Identifier
    """Name of the file as it came."""
    suffix: str
    size_bytes: Count
    sha256: str
    added_t_ns: TNs
    film: FilmInfo
    alignment: Alignment | None = None
    """None: its time is not known."""


def find_video_folders(session_folder: Path) -> dict[str, Path]:
    """List a session's video folders by id, sorted.

    Raises:
        StorageError: they cannot be read now.
    """
    try:
        found = sorted((session_folder / VIDEOS_FOLDER).iterdir())
        return {
            path.name: path
            for path in found
            if _VIDEO_ID.fullmatch(path.name) and path.is_dir() and not path.is_symlink()
        }
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except OSError as error:
        raise StorageError(
            f"cannot be read: {error.strerror}",
            where=str(session_folder / VIDEOS_FOLDER),
            errno=error.errno,
        ) from error


def find_video_folder(session_folder: Path, video_id: str) -> Path:
    """Find the folder of one video.

    Raises:
        UnknownError: there is none with this id.
        StorageError: it cannot be read now.
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
        DamagedFileError: it is missing, or was changed.
        FileFormatError: it is of another version.
        StorageError: it cannot be read now.
    """
    try:
        return read_document(folder / VIDEO_NAME, Video)
    except FileNotFoundError as error:
        raise DamagedFileError("the video has no description", where=str(folder)) from error


def get_film_path(folder: Path, video: Video) -> Path:
    """Return the path of a video's file."""
    return folder / f"{FILM_STEM}{video.suffix}"


def write_video(folder: Path, video: Video) -> None:
    """Write the description of a video; an existing one is replaced.

    Raises:
        StorageError: the disk is full or not writable.
    """
    write_document(folder / VIDEO_NAME, video)


def check_suffix(name: str) -> str:
    """Return the suffix of a film's name, in lower case.

    Raises:
        FileFormatError: films do not end so.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        raise FileFormatError(f"{name[:80]!r} is no film", expected=", ".join(SUFFIXES))
    return suffix


class IncomingVideo:
    """Folder of a video whose file is being written; without `finish` it is deleted.

    Args:
        session_folder: folder of the session.
        name: name of the file as it came.

    Raises:
        FileFormatError: films do not end so.
        StorageError: the folder cannot be made.
    """

    def __init__(self, session_folder: Path, name: str) -> None:
        self.name, self.suffix = name, check_suffix(name)
        self.id = secrets.token_hex(6)
        self._final = session_folder / VIDEOS_FOLDER / self.id
        # A name that no listing shows, and that a start of the server deletes.
        self.folder = self._final.with_name(f"{DELETED_PREFIX}{self.id}")
        self.film_path = self.folder / f"{FILM_STEM}{self.suffix}"
        make_synced_folder(self.folder)

    def write(self, chunks: Iterable[bytes]) -> None:
        """Write the file.

        Raises:
            StorageError: the disk is full or not writable.
        """
        with open_for_atomic_write(self.film_path) as file:
            for chunk in chunks:
                file.write(chunk)

    def finish(self, film: FilmInfo, added_t_ns: int) -> Video:
        """Describe the video and put its folder in place.

        Raises:
            StorageError: the disk is full or not writable.
        """
        video = Video(
            id=self.id,
            name=self.name,
            suffix=self.suffix,
            size_bytes=self.film_path.stat().st_size,
            sha256=compute_sha256(self.film_path),
            added_t_ns=added_t_ns,
            film=film,
        )
        write_video(self.folder, video)
        with translate_storage_errors(self._final):
            self.folder.rename(self._final)
        sync_folder(self._final.parent)
        return video

    def discard(self) -> None:
        """Delete what was written."""
        shutil.rmtree(self.folder, ignore_errors=True)


def remove_video(session_folder: Path, video_id: str) -> None:
    """Delete a video with all that was made of it.

    Raises:
        UnknownError: there is none with this id.
        StorageError: it cannot be deleted.
    """
    folder = find_video_folder(session_folder, video_id)
    doomed = folder.with_name(f"{DELETED_PREFIX}{video_id}")
    with translate_storage_errors(folder):
        folder.rename(doomed)  # at once, for all readers
        shutil.rmtree(doomed)


def verify_videos(session_folder: Path) -> list[str]:
    """Verify the files of a session's videos by their hashes; return what is wrong, as text."""
    problems = []
    for video_id, folder in find_video_folders(session_folder).items():
        try:
            video = read_video(folder)
            if compute_sha256(get_film_path(folder, video)) != video.sha256:
                problems.append(f"video {video_id}: {video.name} was changed")
        except FileNotFoundError:
            problems.append(f"video {video_id}: its file is missing")
        except (FileFormatError, StorageError) as error:
            problems.append(f"video {video_id}: {error.what}")
    return problems
