"""Sessions: metadata, lazy access to their frames, markers, stop and download."""

from __future__ import annotations

import hashlib
import io
import os
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, overload
from urllib.parse import quote

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from foottile.errors import ClientError, ConflictError, DamagedError, InvalidRequestError
from foottile.http import HttpClient

if TYPE_CHECKING:
    import httpx


Clock = Literal["node", "server"]

_CHUNK_BYTES = 1 << 16
_WRITE_BYTES = 1 << 20
_ARROW_START, _ARROW_END = b"ARROW1\0\0", b"ARROW1"
"""First and last bytes of an Arrow IPC file."""


@dataclass(frozen=True)
class SessionData:
    """Frames of a session, or a slice; the server sends only the selected part.

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
            InvalidRequestError: a slice with a step, or an invalid column name.
            ClientError: as for `iter_batches`.
        """
        if isinstance(key, str):
            columns = list(replace(self, columns=(key,)).to_numpy().values())
            return columns[0] if len(columns) == 1 else np.stack(columns, axis=1)
        if isinstance(key, slice):
            return self._slice_seconds(key)
        names = tuple(key)
        if not names or not all(isinstance(name, str) for name in names):
            raise InvalidRequestError(f"{key!r} is no list of columns")
        return replace(self, columns=names)

    def iter_batches(self) -> Iterator[pa.RecordBatch]:
        """Yield the frames in batches of some thousand, as the network delivers them.

        Raises:
            InvalidRequestError: no such column, or no such time in the session.
            ClientError: no response, no such session, or a damaged or interrupted response.
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
            except ClientError:  # some are also OSErrors
                raise
            except (pa.ArrowInvalid, OSError, EOFError) as error:
                raise DamagedError(
                    f"session {self.session_id} arrived incomplete or damaged: {error}"
                ) from error

    def to_arrow(self) -> pa.Table:
        """Return an Arrow table; units and descriptions are in the metadata of its fields.

        Raises:
            ClientError: as for `iter_batches`, or the slice has no frame.
        """
        batches = list(self.iter_batches())
        if not batches:
            raise ClientError(f"session {self.session_id} has no frame in this slice")
        return pa.Table.from_batches(batches)

    def to_pandas(self) -> Any:
        """Return a pandas DataFrame; unknown values are NaN.

        Raises:
            ClientError: as for `to_arrow`, or pandas is not installed.
        """
        try:
            return self.to_arrow().to_pandas()
        except ModuleNotFoundError as error:
            raise ClientError("this needs pandas: pip install pandas") from error

    def to_numpy(self) -> dict[str, npt.NDArray[Any]]:
        """Return arrays by name, [n]; unknown values are NaN, also in columns of integers.

        Raises:
            ClientError: as for `to_arrow`.
        """
        table = self.to_arrow()
        return {name: table[name].to_numpy() for name in table.column_names}

    def _slice_seconds(self, seconds: slice) -> SessionData:
        if seconds.step is not None:
            raise InvalidRequestError("a slice of seconds has no step; expected begin and end only")
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
        ClientError: no response, or a problem response.
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


_POLL_S = 0.2


@dataclass(frozen=True)
class SessionMarker:
    """Labelled instant of a session.

    Attributes:
        id: unique id within the session.
        label: text.
        t_ns: instant in the server's UTC, nanoseconds since 1970.
    """

    id: str
    label: str
    t_ns: int

    @classmethod
    def create(cls, metadata: Mapping[str, Any]) -> SessionMarker:
        """Return a marker from the server's JSON."""
        return cls(metadata["id"], metadata["label"], metadata["t_ns"])


class RemoteSession:
    """Session with its `metadata` at the last response, with every field of the API.

    As a context manager it stops a running recording at the end of the block.
    """

    def __init__(self, http: HttpClient, metadata: Mapping[str, Any]) -> None:
        self._http = http
        self.metadata: Mapping[str, Any] = metadata

    def __repr__(self) -> str:
        what = f"{self.name!r} of {self.node}, {self.duration_s:.1f} s, {self.state}"
        return f"<RemoteSession {self.id} {what}>"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        try:
            if self.refresh().state == "recording":
                self.stop()
        except ClientError:
            if error is None:  # else the error of the block matters more
                raise

    @property
    def id(self) -> str:
        """Unique id."""
        return str(self.metadata["id"])

    @property
    def name(self) -> str:
        """Name for people."""
        return str(self.metadata["name"])

    @property
    def node(self) -> str:
        """Name of the recorded node."""
        return str(self.metadata["node"])

    @property
    def state(self) -> str:
        """`recording`, `pending` (frames are still to come), `sealing` or `sealed`."""
        return str(self.metadata["state"])

    @property
    def complete(self) -> bool | str:
        """Completeness. True: all sampled frames stored; False: undecided; "lossy": some are lost.

        A node that was late leaves frames out: `not_sampled_share`.
        """
        complete: bool | str = self.metadata["complete"]
        return complete

    @property
    def not_sampled_frames(self) -> int:
        """Number of frames that the node did not sample, because it was late."""
        return int(self.metadata["missed_slots"])

    @property
    def not_sampled_share(self) -> float:
        """Their share of all slots of the session, 0 to 1."""
        return float(self.metadata["not_sampled_share"])

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return int(self.metadata["frames"])

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the last, s."""
        return float(self.metadata["duration_s"])

    @property
    def tags(self) -> tuple[str, ...]:
        """Tags."""
        return tuple(self.metadata["tags"])

    @property
    def take(self) -> str | None:
        """Id of the take; None for a session of a single node."""
        found: str | None = self.metadata["take"]
        return found

    def refresh(self) -> Self:
        """Fetch the present metadata.

        Raises:
            ClientError: no response, or no such session.
        """
        self.metadata = self._http.get(self._path)
        return self

    def open(
        self,
        columns: Sequence[str] = (),
        *,
        start_s: float | None = None,
        end_s: float | None = None,
        clock: Clock = "node",
    ) -> SessionData:
        """Return the frames, or a slice, without fetching anything yet.

        Args:
            columns: names, of all tiles (`force_n`) or one (`force_n_0`); empty: all.
            start_s: first instant, seconds after the first frame.
            end_s: end, exclusive.
            clock: `server` adds `t_server_ns`, comparable with markers, and its bound.
        """
        names = (columns,) if isinstance(columns, str) else tuple(columns)
        return SessionData(self._http, self.id, names, start_s, end_s, clock)

    def markers(self) -> list[SessionMarker]:
        """Return the markers, in order of time.

        Raises:
            ClientError: no response, or no such session.
        """
        found = self._http.get(f"{self._path}/markers", field="items")
        return [SessionMarker.create(each) for each in found["items"]]

    def add_marker(self, label: str, *, t_ns: int | None = None) -> SessionMarker:
        """Add a marker now, or at an instant of the server's UTC; a repeated request adds it once.

        Raises:
            ClientError: no response, or a problem response.
        """
        body = {"label": label, "t_ns": t_ns, "id": uuid.uuid4().hex[:12]}
        path = f"{self._path}/markers"
        return SessionMarker.create(self._http.send("POST", path, body, is_idempotent=True))

    def update(
        self,
        *,
        name: str | None = None,
        subject: str | None = None,
        notes: str | None = None,
        tags: Sequence[str] | None = None,
    ) -> Self:
        """Change the given metadata.

        Raises:
            ConflictError: the metadata changed since the last response; `refresh` it.
            ClientError: no response, or a problem response.
        """
        body = {"name": name, "subject": subject, "notes": notes}
        changes: dict[str, object] = {**body, "tags": None if tags is None else list(tags)}
        headers = {"If-Match": f'"{self.metadata["revision"]}"'}
        self.metadata = self._http.send("PATCH", self._path, changes, headers=headers)
        return self

    def stop(self) -> Self:
        """Stop the recording; return when it is sealed, or after some seconds.

        Raises:
            ClientError: no response, or no such session.
        """
        self.metadata = self._http.send("POST", f"{self._path}/stop", is_idempotent=True)
        return self

    def wait_until_sealed(self, timeout_s: float = 60.0) -> Self:
        """Wait until the session is sealed.

        Args:
            timeout_s: longest wait. Sealing an hour takes some tens of seconds; the first session
                on a new machine also waits for the compilation of models.

        Raises:
            ConflictError: not sealed at the timeout; the text has the reason. Retry.
            ClientError: no response.
        """
        end_s = time.monotonic() + timeout_s
        while self.refresh().state != "sealed":
            if time.monotonic() > end_s:
                reason = _explain_not_sealed(self.metadata)
                raise ConflictError(
                    f"session {self.id} is not sealed after {timeout_s:g} s: {reason}"
                )
            time.sleep(_POLL_S)
        return self

    def download(self, path: str | os.PathLike[str], *, format: str = "parquet") -> Path:  # noqa: A002  # the API's name
        """Download the session as a file, atomically; the hash of Parquet is verified.

        Raises:
            ConflictError: the session is not sealed, for Parquet.
            DamagedError: the hash differs from the server's.
            OSError: the file cannot be written.
            ClientError: no response, or a problem response.
        """

        def get_expected_sha256() -> str | None:
            sha256: str | None = self.refresh().metadata["sha256"]
            return sha256 if format == "parquet" else None

        return download(
            self._http, f"{self._path}/data", {"format": format}, path, get_expected_sha256
        )

    @property
    def _path(self) -> str:
        return f"/sessions/{quote(self.id, safe='')}"


def _explain_not_sealed(metadata: Mapping[str, Any]) -> str:
    if metadata["problem"]:
        return str(metadata["problem"])
    reason = metadata["pending_reason"] or "frames"
    return {
        "recording": "it is still recording; stop it",
        "pending": f"it is stopped, and waits for its node's {reason}",
    }.get(metadata["state"], "the server is writing it; retry")
