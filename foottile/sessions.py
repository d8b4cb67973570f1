"""Sessions: what is known of one, its frames and markers, and how it is ended."""

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

from foottile.data import Clock, Data
from foottile.errors import ConflictError, FootTileError
from foottile.files import download
from foottile.http import Http

_LOOK_EVERY_S = 0.2


@dataclass(frozen=True)
class Marker:
    """Something that was marked.

    Attributes:
        id: its own, within the session.
        label: what was written.
        t_ns: when, in the server's UTC, nanoseconds since 1970.
    """

    id: str
    label: str
    t_ns: int

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Marker:
        """As the server says it."""
        return cls(facts["id"], facts["label"], facts["t_ns"])


class Session:
    """A session, as the server described it last (`facts`, with every field of the API).

    As a context manager it is stopped at the end of the block, if it is still being recorded.
    """

    def __init__(self, http: Http, facts: Mapping[str, Any]) -> None:
        self._http = http
        self.facts: Mapping[str, Any] = facts

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
            if error is None:  # else that is what has to be told
                raise

    @property
    def id(self) -> str:
        """Its name for machines."""
        return str(self.facts["id"])

    @property
    def name(self) -> str:
        """Its name for people."""
        return str(self.facts["name"])

    @property
    def node(self) -> str:
        """Whose frames they are."""
        return str(self.facts["node"])

    @property
    def state(self) -> str:
        """`recording`, `pending` (frames are still to come), `sealing` or `sealed`."""
        return str(self.facts["state"])

    @property
    def complete(self) -> bool | str:
        """Is every frame there? False: not yet known; "lossy": some are lost for good."""
        complete: bool | str = self.facts["complete"]
        return complete

    @property
    def frames(self) -> int:
        """How many it has."""
        return int(self.facts["frames"])

    @property
    def duration_s(self) -> float:
        """From its first frame to its last."""
        return float(self.facts["duration_s"])

    @property
    def tags(self) -> tuple[str, ...]:
        """What people wrote to find it again."""
        return tuple(self.facts["tags"])

    @property
    def take(self) -> str | None:
        """The take that it is of: its id, None of a session that was recorded by itself."""
        found: str | None = self.facts["take"]
        return found

    def refresh(self) -> Self:
        """Ask what is known of it now.

        Raises:
            FootTileError: no answer, or it is gone.
        """
        self.facts = self._http.get(self._path)
        return self

    def open(
        self,
        columns: Sequence[str] = (),
        *,
        start_s: float | None = None,
        end_s: float | None = None,
        clock: Clock = "node",
    ) -> Data:
        """Its frames, or some columns and seconds of them; nothing is fetched yet.

        Args:
            columns: names, of all tiles (`force_n`) or one (`force_n_0`); none: all.
            start_s: from so many seconds after the first frame on.
            end_s: before so many seconds.
            clock: of `server` there are also `t_server_ns`, to compare with markers, and its bound.
        """
        names = (columns,) if isinstance(columns, str) else tuple(columns)
        return Data(self._http, self.id, names, start_s, end_s, clock)

    def markers(self) -> list[Marker]:
        """What was marked in it, in order of time.

        Raises:
            FootTileError: no answer, or it is gone.
        """
        return [
            Marker.of(each)
            for each in self._http.get(f"{self._path}/markers", has="items")["items"]
        ]

    def add_marker(self, label: str, *, t_ns: int | None = None) -> Marker:
        """Marker this moment, or another one of the server's UTC; sent twice, it is marked once.

        Raises:
            FootTileError: no answer, or it is refused.
        """
        body = {"label": label, "t_ns": t_ns, "id": uuid.uuid4().hex[:12]}
        return Marker.of(self._http.send("POST", f"{self._path}/markers", body, again=True))

    def describe(
        self,
        *,
        name: str | None = None,
        subject: str | None = None,
        notes: str | None = None,
        tags: Sequence[str] | None = None,
    ) -> Self:
        """Change what people say of it; what is left out stays.

        Raises:
            ConflictError: somebody else has changed it since it was asked for; `refresh` it.
            FootTileError: no answer, or it is refused.
        """
        body = {"name": name, "subject": subject, "notes": notes}
        changes: dict[str, object] = {**body, "tags": None if tags is None else list(tags)}
        headers = {"If-Match": f'"{self.facts["revision"]}"'}
        self.facts = self._http.send("PATCH", self._path, changes, headers=headers)
        return self

    def stop(self) -> Self:
        """End the recording. Answers when it is sealed, or after some seconds.

        Raises:
            FootTileError: no answer, or it is gone.
        """
        self.facts = self._http.send("POST", f"{self._path}/stop", again=True)
        return self

    def wait(self, timeout_s: float = 60.0) -> Self:
        """Wait until it is sealed.

        Args:
            timeout_s: not longer than that; to seal an hour takes some tens of seconds, and the
                first session of a new machine waits until models are compiled.

        Raises:
            ConflictError: it is not by then, and says what it waits for; it may be asked again.
            FootTileError: no answer.
        """
        end_s = time.monotonic() + timeout_s
        while self.refresh().state != "sealed":
            if time.monotonic() > end_s:
                raise ConflictError(
                    f"session {self.id} is not sealed after {timeout_s:g} s: {_why_not(self.facts)}"
                )
            time.sleep(_LOOK_EVERY_S)
        return self

    def download(self, path: str | os.PathLike[str], *, format: str = "parquet") -> Path:  # noqa: A002  # the API's name
        """All of it as a file, which appears whole or not at all; Parquet is checked by its hash.

        Raises:
            ConflictError: it is not sealed, for Parquet.
            DamagedError: what came has not the hash that the server states.
            OSError: the file cannot be written.
            FootTileError: no answer, or it is refused.
        """

        def expected() -> str | None:
            sha256: str | None = self.refresh().facts["sha256"]
            return sha256 if format == "parquet" else None

        return download(self._http, f"{self._path}/data", {"format": format}, path, expected)

    @property
    def _path(self) -> str:
        return f"/sessions/{quote(self.id, safe='')}"


def _why_not(facts: Mapping[str, Any]) -> str:
    if facts["problem"]:
        return str(facts["problem"])
    return {
        "recording": "it is still being recorded, and waits for its stop",
        "pending": f"it is stopped, and waits for its node's {facts['pending_reason'] or 'frames'}",
    }.get(facts["state"], "the server is writing it; wait again")
