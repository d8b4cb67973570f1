"""Locations of sessions: local paths and URIs of object stores, with uniform file access.

A location is a session (its folder, or a single file), a folder of sessions, a data folder, a local
glob of these, or a URI: `s3://bucket/prefix`, opened by Arrow, or that of any other fsspec
filesystem. Sessions are yielded one by one, because a folder may contain any number.
"""

from __future__ import annotations

import glob
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, cast
from urllib.parse import urlsplit

import pyarrow.fs as fs

from devices.errors import (
    FileFormatError,
    StorageError,
    UsageError,
    escape_control_chars,
    is_utf8_encodable,
    require_extra,
)
from foottile.environment import read_variable
from storage.durable_files import ASIDE_SUFFIX
from storage.sessions.folder import FRAMES_NAME, SESSION_ID
from storage.sessions.metadata import SESSION_NAME

_EXPECTED = "a session, a folder of sessions, a data folder, a glob of these, or a URI of one"
_DATA_FOLDER_NAMES = ("sessions", "journal")
_S3_ATTEMPTS = 6
_BLOCK = 1 << 20
"""Attempts of a request that the store refuses or aborts, with exponential backoff, 3 s in all."""
_S3_CONNECT_S = 10.0


@dataclass(frozen=True)
class SessionLocation:
    """Location of one session.

    Attributes:
        uri: its folder or file, as a path or URI.
        session_id: session id; for a single file, its name without suffix.
        is_single_file: True for a single file without a session folder.
    """

    uri: str
    session_id: str
    is_single_file: bool = False

    @property
    def frames_uri(self) -> str:
        """Path or URI of the frames file of a sealed session."""
        return self.uri if self.is_single_file else f"{self.uri}/{FRAMES_NAME}"


def is_remote(uri: str) -> bool:
    """Return whether a location is a URI instead of a local path."""
    return "://" in uri


def make_absolute(uri: str) -> str:
    """Return a location that is independent of the working directory."""
    return uri if is_remote(uri) else os.path.abspath(uri)


def open_filesystem(uri: str) -> tuple[fs.FileSystem, str]:
    """Return the filesystem of a location, and the path in it.

    Raises:
        UsageError: the filesystem is not supported.
    """
    if not is_remote(uri):
        return _make_local_filesystem(), os.path.abspath(uri)
    parsed = urlsplit(uri)
    if parsed.scheme == "s3":
        return _make_s3_filesystem(), f"{parsed.netloc}{parsed.path}".rstrip("/")
    return _open_fsspec(uri)


def find_session_locations(locations: Iterable[str]) -> Iterator[SessionLocation]:
    """Find every session at some locations, in no order.

    Raises:
        UsageError: a location does not exist; raised before the first session.
        StorageError: a store does not answer.
    """
    roots = [root for place in locations for root in _expand_location(place)]
    return (session for root in roots for session in _find_in_root(root))


def make_no_session_error(locations: Iterable[str]) -> UsageError:
    """Return the error for locations without a session; it names single files found in them."""
    folders = [
        root for place in locations if not is_remote(place) for root in _expand_location(place)
    ]
    lone = [path for root in folders for path in sorted(glob.glob("*.parquet", root_dir=root))]
    what = "there is no session in these places"
    if not lone:
        return UsageError(what, expected=_EXPECTED)
    more = f" and {len(lone) - 1} more" if lone[1:] else ""
    return UsageError(
        f"{what}, but files by themselves: {escape_control_chars(lone[0])}{more}",
        expected=_EXPECTED,
        remedy="Name the files, or a glob of them in quotes, where a command takes files",
    )


def is_data_folder(uri: str) -> bool:
    """Return whether a location is a data folder of a server or node, perhaps without a session."""
    return any(
        _get_file_type(f"{uri.rstrip('/')}/{name}") == fs.FileType.Directory
        for name in _DATA_FOLDER_NAMES
    )


def parse_session_location(uri: str) -> SessionLocation:
    """Return the location of one session by its folder or file, without checking that it exists."""
    uri = uri.rstrip("/") or "/"
    folder, _, name = uri.rpartition("/")
    if name == FRAMES_NAME and SESSION_ID.fullmatch(folder.rpartition("/")[2]):
        return SessionLocation(folder, folder.rpartition("/")[2])
    is_file = name.endswith(".parquet")
    return SessionLocation(uri, name.removesuffix(".parquet") if is_file else name, is_file)


def read_bytes(uri: str) -> bytes:
    """Read a local or remote file.

    Raises:
        FileFormatError: the file does not exist.
        StorageError: it cannot be read now.
    """
    with open_for_reading(uri) as file:
        return file.read()


@contextmanager
def open_for_reading(uri: str) -> Iterator[BinaryIO]:
    """Open a local or remote file for reading.

    Raises:
        FileFormatError: the file does not exist.
        StorageError: it cannot be read now.
    """
    filesystem, path = open_filesystem(uri)
    try:
        with filesystem.open_input_file(path) as file:
            yield cast("BinaryIO", file)
    except (FileFormatError, StorageError):
        raise
    except OSError as error:
        raise make_read_error(uri, error) from error


def make_read_error(uri: str, error: OSError) -> FileFormatError | StorageError:
    """Return the error for a file or folder that cannot be read."""
    if isinstance(error, FileNotFoundError):
        return FileFormatError("there is no such file", where=uri)
    text = escape_control_chars(" ".join(str(error).split()))[:300]
    return StorageError(f"cannot be read: {text}", where=uri, remedy="Try again", errno=error.errno)


def upload(uri: str, content: bytes | Path) -> None:
    """Write bytes or a local file's content to a store.

    Raises:
        StorageError: it cannot be written.
    """
    filesystem, path = open_filesystem(uri)
    with convert_write_errors(uri), filesystem.open_output_stream(path) as sink:
        if isinstance(content, bytes):
            sink.write(content)
        else:
            with content.open("rb") as source:
                shutil.copyfileobj(source, sink, _BLOCK)


@contextmanager
def convert_write_errors(uri: str) -> Iterator[None]:
    """Convert a filesystem's write errors to `StorageError`."""
    try:
        yield
    except StorageError:
        raise
    except OSError as error:
        text = escape_control_chars(" ".join(str(error).split()))[:300]
        raise StorageError(
            f"cannot be written: {text}", where=uri, remedy="Try again", errno=error.errno
        ) from error


def list_file_sizes(folder_uri: str) -> dict[str, int]:
    """Return the sizes in bytes of the files in a folder by name, without hidden files.

    Raises:
        StorageError: a store does not answer.
    """
    filesystem, path = open_filesystem(folder_uri)
    try:
        found = filesystem.get_file_info(fs.FileSelector(path, allow_not_found=True))
    except OSError as error:
        raise make_read_error(folder_uri, error) from error
    files = (info for info in found if info.type == fs.FileType.File)
    return {info.base_name: info.size for info in files if not info.base_name.startswith(".")}


@cache
def _make_local_filesystem() -> fs.FileSystem:
    return fs.LocalFileSystem()


@cache
def _make_s3_filesystem() -> fs.FileSystem:
    """Open S3 with credentials, region and endpoint from the usual environment variables."""
    endpoint = read_variable("AWS_ENDPOINT_URL_S3") or read_variable("AWS_ENDPOINT_URL")
    library: Any = fs  # its stubs are of an older one
    filesystem: fs.FileSystem = library.S3FileSystem(
        endpoint_override=endpoint,
        allow_delayed_open=True,  # one request for a small file, not three
        connect_timeout=_S3_CONNECT_S,
        retry_strategy=library.AwsStandardS3RetryStrategy(max_attempts=_S3_ATTEMPTS),
    )
    return filesystem


def _open_fsspec(where: str) -> tuple[fs.FileSystem, str]:
    with require_extra("archive", f"a place like {where[:60]!r}"):
        from fsspec.core import url_to_fs
    try:
        filesystem, path = url_to_fs(where)
    except (ValueError, ImportError) as error:
        raise UsageError(
            f"no place {where!r}: {error}",
            expected=_EXPECTED,
            remedy="Install the package that opens it, if there is one",
        ) from error
    handler: Any = fs.FSSpecHandler  # its stubs call it abstract
    return fs.PyFileSystem(handler(filesystem)), path.rstrip("/")


def _expand_location(place: str) -> list[str]:
    """Return the folders and files that a location names, at least one."""
    if is_remote(place):
        if _get_file_type(place) == fs.FileType.NotFound:
            raise UsageError(f"no place {place!r}", expected=_EXPECTED)
        return [place.rstrip("/")]
    paths = [place] if os.path.exists(place) else glob.glob(place)
    roots = [
        make_absolute(path) for path in paths if os.path.isdir(path) or path.endswith(".parquet")
    ]
    if not roots:
        raise UsageError(f"no session or folder {place!r}", expected=_EXPECTED)
    return roots


def _find_in_root(root: str) -> Iterator[SessionLocation]:
    if _get_file_type(root) == fs.FileType.File or SESSION_ID.fullmatch(os.path.basename(root)):
        yield parse_session_location(root)
    elif _get_file_type(f"{root}/{SESSION_NAME}") == fs.FileType.File:
        yield SessionLocation(root, os.path.basename(root))
    else:
        inside = f"{root}/sessions"
        inside = inside if _get_file_type(inside) == fs.FileType.Directory else root
        for name in _list_names(inside):
            if SESSION_ID.fullmatch(name) or _is_renamed(f"{inside}/{name}", name):
                yield SessionLocation(f"{inside}/{name}", name)


def _is_renamed(where: str, name: str) -> bool:
    """Return whether a local session's folder name differs from its id; not checked in a store."""
    is_ours = name.startswith(".") or ASIDE_SUFFIX in name
    return not is_ours and not is_remote(where) and os.path.isfile(f"{where}/{SESSION_NAME}")


def check_utf8(location: SessionLocation) -> None:
    """Check that a path can be written to results.

    Raises:
        UsageError: it is not valid UTF-8.
    """
    if not is_utf8_encodable(location.uri):
        raise UsageError(
            "the path is not UTF-8",
            where=location.uri,
            expected="a path that JSON can state",
            remedy="Rename the folder",
        )


def _list_names(folder: str) -> Iterator[str]:
    """Yield the names in a folder: one by one locally, from one listing in a store."""
    if not is_remote(folder):
        with os.scandir(folder) as entries:
            for entry in entries:
                yield entry.name
        return
    filesystem, path = open_filesystem(folder)
    try:
        found = filesystem.get_file_info(fs.FileSelector(path))
    except OSError as error:
        raise make_read_error(folder, error) from error
    yield from (info.base_name for info in found if info.type == fs.FileType.Directory)


def _get_file_type(where: str) -> fs.FileType:
    filesystem, path = open_filesystem(where)
    try:
        return filesystem.get_file_info(path).type
    except OSError as error:
        raise make_read_error(where, error) from error
