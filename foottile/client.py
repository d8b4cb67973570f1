"""Client of one server: nodes, sessions, recording and live streams."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from foottile.connection import Closeable
from foottile.http import HttpClient
from foottile.live import FrameLoss, LiveRequest, LiveStream, Policy
from foottile.sessions import RemoteSession, download

_PAGE = 500


class Client(Closeable):
    """Thread-safe client of one server, created by `foottile.connect`.

    Every method raises a `ClientError` without a response, or for a problem response.
    """

    def __init__(
        self,
        url: str,
        token: str | None = None,
        *,
        timeout_s: float = 10.0,
        ca: str | os.PathLike[str] | None = None,
    ) -> None:
        self.http = HttpClient(url, token, timeout_s, ca)
        """HTTP client for routes without a method here: `server.http.get("/calibrations")`."""

    def close(self) -> None:
        """Close all connections."""
        self.http.close()

    @property
    def url(self) -> str:
        """Address of the server."""
        return self.http.url

    @property
    def headers(self) -> dict[str, str]:
        """Headers of every request: the token, if any."""
        return dict(self.http.headers)

    def nodes(self) -> list[dict[str, Any]]:
        """Return all nodes, with the fields of the API: `node`, `connected`, `tiles`, ..."""
        items: list[dict[str, Any]] = self.http.get("/nodes", field="items")["items"]
        return items

    def node(self, name: str) -> dict[str, Any]:
        """Return one node."""
        return self.http.get(f"/nodes/{quote(name, safe='')}")

    def sessions(
        self,
        search: str | None = None,
        *,
        node: str | Sequence[str] | None = None,
        tag: str | Sequence[str] | None = None,
        take: str | None = None,
        since: datetime | str | None = None,
        until: datetime | str | None = None,
        complete: bool | str | None = None,
    ) -> Iterator[RemoteSession]:
        """Yield sessions, newest first; pages are fetched on demand.

        Args:
            search: text in name, subject, notes, tags or node.
            node: filter by node; several: any of these.
            tag: filter by tag; several: all of these.
            take: filter by take.
            since: earliest start; an instant without a zone is local time.
            until: end of the starts, exclusive.
            complete: True, False or "lossy".
        """
        query: dict[str, object] = {
            "q": search,
            "node": _as_list(node),
            "tag": _as_list(tag),
            "take": take,
            "from": _format_instant(since),
            "to": _format_instant(until),
            "complete": complete,
            "limit": _PAGE,
        }
        while True:
            page = self.http.get("/sessions", query, field="next_cursor")
            for metadata in page["items"]:
                yield RemoteSession(self.http, metadata)
            if page["next_cursor"] is None:
                return
            query["cursor"] = page["next_cursor"]

    def session(self, session_id: str) -> RemoteSession:
        """Return one session."""
        return RemoteSession(
            self.http, self.http.get(f"/sessions/{quote(session_id, safe='')}", field="id")
        )

    def download_take(
        self,
        take: str,
        path: str | os.PathLike[str],
        *,
        format: str,  # noqa: A002  # the API's name
        start_s: float | None = None,
        end_s: float | None = None,
    ) -> Path:
        """Download all sessions of a take as one file, on the server's time axis.

        Args:
            take: id of the take, `RemoteSession.take`.
            path: file to write, atomically.
            format: format for several sessions: `c3d`, `opensim`, `mcap`, `mat`, `xdf`.
            start_s: first instant, seconds after the first frame of all sessions, by the server's
                clock; None: the beginning.
            end_s: end, exclusive; None: the end.

        Raises:
            ConflictError: a session is not sealed.
            InvalidRequestError: the format holds one session only, or cannot hold one of these.
            OSError: the file cannot be written.
        """
        query = {"format": format, "start_s": start_s, "end_s": end_s}
        return download(self.http, f"/takes/{quote(take, safe='')}/data", query, path)

    def record(
        self,
        node: str,
        name: str,
        *,
        pre_roll_s: float = 0.0,
        subject: str | None = None,
        notes: str = "",
        tags: Sequence[str] = (),
    ) -> RemoteSession:
        """Start recording a node, `pre_roll_s` in the past; a repeated request starts it once.

        As a context manager the session stops at the end of the block.
        """
        body: dict[str, object] = {"node": node, "name": name, "pre_roll_s": float(pre_roll_s)}
        body |= {"subject": subject, "notes": notes, "tags": list(tags)}
        key = {"Idempotency-Key": uuid.uuid4().hex}
        return RemoteSession(
            self.http, self.http.send("POST", "/sessions", body, headers=key, is_idempotent=True)
        )

    def tare(self, node: str, reason: str = "") -> dict[str, Any]:
        """Tare with the newest unloaded quarter of a second of the last ten seconds.

        Raises:
            ConflictError: the foot is loaded or moves, or the node is away.
        """
        return self.http.send("POST", f"/nodes/{quote(node, safe='')}/tare", {"reason": reason})

    def tares(self, node: str) -> list[dict[str, Any]]:
        """Return the tares of a node, newest first."""
        path = f"/nodes/{quote(node, safe='')}/tares"
        items: list[dict[str, Any]] = self.http.get(path, field="items")["items"]
        return items

    def create_invite(self, *, role: str = "operator") -> dict[str, Any]:
        """Create a login link for an `operator` or a `viewer`; this needs the server's token."""
        return self.http.send("POST", "/tickets", {"role": role})

    def live(
        self,
        node: str | None = None,
        columns: Sequence[str] = (),
        *,
        policy: Policy = "lossless",
        stream_id: str | None = None,
        from_seq: int | None = None,
        on_loss: Callable[[FrameLoss], None] | None = None,
        reconnect_timeout_s: float | None = None,
    ) -> LiveStream:
        """Stream frames of a node with estimates, as Arrow batches, from now or from a position.

        Args:
            node: name of the node; None: the only one.
            columns: names, of all tiles (`force_n`) or one (`force_n_0`); empty: all.
            policy: `lossless`: every frame once, across broken links and restarts of the server;
                `drop_oldest`: drops frames that wait for 2 s; `latest`: the newest frames only.
            stream_id: stream of the first frame, as in `LiveStream.position`.
            from_seq: number of the first frame.
            on_loss: receives each loss; None: a `FramesLostWarning` for `lossless`. All losses are
                in `LiveStream.losses`.
            reconnect_timeout_s: longest silence of the server before a `ServerUnavailableError`;
                None: unlimited after the first message.
        """
        request = LiveRequest.create(self.http.url, node, columns, policy, stream_id, from_seq)
        return LiveStream(
            request, self.http, on_loss=on_loss, reconnect_timeout_s=reconnect_timeout_s
        )


def _as_list(value: str | Sequence[str] | None) -> list[str]:
    return [value] if isinstance(value, str) else list(value or ())


def _format_instant(value: datetime | str | None) -> str | None:
    if isinstance(value, datetime):
        return value.astimezone().isoformat()
    return value
