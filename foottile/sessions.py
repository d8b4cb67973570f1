"""Sessions: metadata, frames, markers, stop and download."""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

from foottile.data import Clock, SessionData, download
from foottile.errors import ConflictError, FootTileError
from foottile.http import HttpClient

_POLL_S = 0.2


@dataclass(frozen=True)
class Marker:
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
    def create(cls, metadata: Mapping[str, Any]) -> Marker:
        """Return a marker from the server's JSON."""
        return cls(metadata["id"], metadata["label"], metadata["t_ns"])


class Session:
    """Session with its `metadata` at the last response, with every field of the API.

    As a context manager it stops a running recording at the end of the block.
    """

    def __init__(self, http: HttpClient, metadata: Mapping[str, Any]) -> None:
        self._http = http
        self.metadata: Mapping[str, Any] = metadata

    def __repr__(self) -> str:
        what = f"{self.name!r} of {self.node}, {self.duration_s:.1f} s, {self.state}"
        return f"<Session {self.id} {what}>"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if self.refresh().state == "recording":
                self.stop()
        except FootTileError:
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
        """Completeness. True: all frames stored; False: undecided; "lossy": frames are lost."""
        complete: bool | str = self.metadata["complete"]
        return complete

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
            FootTileError: no response, or no such session.
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
        """Return the frames, or a slice of them, without fetching anything yet.

        Args:
            columns: names, of all tiles (`force_n`) or one (`force_n_0`); empty: all.
            start_s: first instant, seconds after the first frame.
            end_s: end, exclusive.
            clock: `server` adds `t_server_ns`, comparable with markers, and its bound.
        """
        names = (columns,) if isinstance(columns, str) else tuple(columns)
        return SessionData(self._http, self.id, names, start_s, end_s, clock)

    def markers(self) -> list[Marker]:
        """Return the markers, in order of time.

        Raises:
            FootTileError: no response, or no such session.
        """
        found = self._http.get(f"{self._path}/markers", field="items")
        return [Marker.create(each) for each in found["items"]]

    def add_marker(self, label: str, *, t_ns: int | None = None) -> Marker:
        """Add a marker now, or at an instant of the server's UTC; a repeated request adds it once.

        Raises:
            FootTileError: no response, or a problem response.
        """
        body = {"label": label, "t_ns": t_ns, "id": uuid.uuid4().hex[:12]}
        path = f"{self._path}/markers"
        return Marker.create(self._http.send("POST", path, body, is_idempotent=True))

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
            FootTileError: no response, or a problem response.
        """
        body = {"name": name, "subject": subject, "notes": notes}
        changes: dict[str, object] = {**body, "tags": None if tags is None else list(tags)}
        headers = {"If-Match": f'"{self.metadata["revision"]}"'}
        self.metadata = self._http.send("PATCH", self._path, changes, headers=headers)
        return self

    def stop(self) -> Self:
        """Stop the recording; return when it is sealed, or after some seconds.

        Raises:
            FootTileError: no response, or no such session.
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
            FootTileError: no response.
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
            FootTileError: no response, or a problem response.
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
