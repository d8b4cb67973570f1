"""Lazy access to the frames of a session."""

from __future__ import annotations

import hashlib
import io
import os
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from foottile.errors import DamagedError, FootTileError, UsageError
from foottile.http import HttpClient

if TYPE_CHECKING:
    import httpx

Clock = Literal["node", "server"]

_CHUNK_BYTES = 1 << 16
_ARROW_START, _ARROW_END = b"ARROW1\0\0", b"ARROW1"
"""First and last bytes of an Arrow IPC file."""


@dataclass(frozen=True)
class SessionData:
    """Frames of a session, or a slice of them; the server sends only the selected part.

    `data["grf_n"]` fetches a column as numpy. `data[["t_ns", "grf_n"]]` and `data[2.0:3.0]`
    (seconds from the session's first frame) select a part and fetch nothing.

    Attributes:
        columns: names, of all tiles (`force_n`) or one (`force_n_0`); empty: all.
        start_s: first instant, seconds after the first frame; None: the beginning.
        end_s: end, exclusive, seconds after the first frame; None: the end.
        clock: `server` adds `t_server_ns`, each frame's instant in the server's UTC, comparable
            with markers, and its bound `t_server_uncertainty_ns`.
    """

    _http: HttpClient
    session_id: str
    columns: tuple[str, ...] = ()
    start_s: float | None = None
    end_s: float | None = None
    clock: Clock = "node"

    @overload
    def __getitem__(self, key: str) -> npt.NDArray[Any]: ...
    @overload
    def __getitem__(self, key: slice | list[str] | tuple[str, ...]) -> SessionData: ...
    def __getitem__(
        self, key: str | slice | list[str] | tuple[str, ...]
    ) -> SessionData | npt.NDArray[Any]:
        """Return a column as numpy, [n] or [n, tiles]; or a selection of columns or seconds.

        Raises:
            UsageError: a slice with a step, or an invalid column name.
            FootTileError: as for `iter_batches`.
        """
        if isinstance(key, str):
            columns = list(replace(self, columns=(key,)).to_numpy().values())
            return columns[0] if len(columns) == 1 else np.stack(columns, axis=1)
        if isinstance(key, slice):
            return self._slice_seconds(key)
        names = tuple(key)
        if not names or not all(isinstance(name, str) for name in names):
            raise UsageError(f"{key!r} is no list of columns")
        return replace(self, columns=names)

    def iter_batches(self) -> Iterator[pa.RecordBatch]:
        """Yield the frames in batches of some thousand, as the network delivers them.

        Raises:
            UsageError: no such column, or no such time in the session.
            FootTileError: no response, no such session, or a damaged or interrupted response.
        """
        query = {
            "format": "arrow",
            "columns": ",".join(self.columns) or None,
            "start_s": self.start_s,
            "end_s": self.end_s,
            "clock": self.clock,
        }
        with self._http.stream(f"/sessions/{self.session_id}/data", query) as response:
            # Buffered: Arrow treats a short read as the end of the file.
            content = io.BufferedReader(_ResponseFile(response), _CHUNK_BYTES)
            try:
                yield from _read_batches(content)
            except FootTileError:  # some are also OSErrors
                raise
            except (pa.ArrowInvalid, OSError, EOFError) as error:
                raise DamagedError(
                    f"session {self.session_id} arrived incomplete or damaged: {error}"
                ) from error

    def to_arrow(self) -> pa.Table:
        """Return an Arrow table; units and descriptions are in the metadata of its fields.

        Raises:
            FootTileError: as for `iter_batches`, or the slice has no frame.
        """
        batches = list(self.iter_batches())
        if not batches:
            raise FootTileError(f"session {self.session_id} has no frame in this slice")
        return pa.Table.from_batches(batches)

    def to_pandas(self) -> Any:
        """Return a pandas DataFrame; unknown values are NaN.

        Raises:
            FootTileError: as for `to_arrow`, or pandas is not installed.
        """
        try:
            return self.to_arrow().to_pandas()
        except ModuleNotFoundError as error:
            raise FootTileError("this needs pandas: pip install pandas") from error

    def to_numpy(self) -> dict[str, npt.NDArray[Any]]:
        """Return arrays by name, [n]; unknown values are NaN, also in columns of integers.

        Raises:
            FootTileError: as for `to_arrow`.
        """
        table = self.to_arrow()
        return {name: table[name].to_numpy() for name in table.column_names}

    def _slice_seconds(self, seconds: slice) -> SessionData:
        if seconds.step is not None:
            raise UsageError("a slice of seconds has no step; expected begin and end only")
        start_s = seconds.start if seconds.start is not None else self.start_s
        end_s = seconds.stop if seconds.stop is not None else self.end_s
        return replace(self, start_s=start_s, end_s=end_s)


def _read_batches(content: io.BufferedIOBase) -> Iterator[pa.RecordBatch]:
    """Yield the batches of an Arrow file while it arrives: after its first bytes it is a stream.

    Raises:
        pa.ArrowInvalid, EOFError: the file is damaged or incomplete.
    """
    if content.read(len(_ARROW_START)) != _ARROW_START:
        raise EOFError("not an Arrow file")
    with pa.ipc.open_stream(pa.PythonFile(content, mode="r")) as reader:
        yield from reader
    if not content.read().endswith(_ARROW_END):
        raise EOFError("the end is missing")


class _ResponseFile(io.RawIOBase):
    """Response as a file for one sequential read."""

    def __init__(self, response: httpx.Response) -> None:
        self._chunks = response.iter_bytes(_CHUNK_BYTES)
        self._rest = memoryview(b"")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        if not self._rest:
            self._rest = memoryview(next(self._chunks, b""))
        n = min(len(buffer), len(self._rest))
        buffer[:n] = self._rest[:n]
        self._rest = self._rest[n:]
        return n


_WRITE_BYTES = 1 << 20


def download(
    http: HttpClient,
    url: str,
    query: Mapping[str, object],
    path: str | os.PathLike[str],
    expected: Callable[[], str | None] | None = None,
) -> Path:
    """Download a file to a temporary name and rename it when it is complete.

    Args:
        http: client of the server.
        url: path below `/api/v1`.
        query: parameters of the request.
        path: file to write.
        expected: returns the expected SHA-256 after the download; None: unknown.

    Raises:
        DamagedError: the hash differs.
        OSError: the file cannot be written.
        FootTileError: no response, or a problem response.
    """
    target = Path(path)
    partial = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    digest = hashlib.sha256()
    try:
        with http.stream(url, query) as response, partial.open("xb") as file:
            for chunk in response.iter_bytes(_WRITE_BYTES):
                digest.update(chunk)
                file.write(chunk)
            file.flush()
            os.fsync(file.fileno())
        sha256 = None if expected is None else expected()
        if sha256 is not None and digest.hexdigest() != sha256:
            raise DamagedError(f"{url}: the download differs from the server's hash. Retry")
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
    return target
