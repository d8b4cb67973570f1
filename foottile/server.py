"""A server: its nodes and sessions, and what is live."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from foottile.closing import Closing
from foottile.files import download
from foottile.http import Http
from foottile.live import Live
from foottile.live_protocol import Asked, Loss, Policy
from foottile.sessions import Session

_PAGE = 500


class Server(Closing):
    """One server; made by `foottile.connect`. May be used from several threads.

    Every method raises a `FootTileError` if there is no answer, or one that is a problem.
    """

    def __init__(
        self,
        url: str,
        token: str | None = None,
        *,
        timeout_s: float = 10.0,
        ca: str | os.PathLike[str] | None = None,
    ) -> None:
        self.http = Http(url, token, timeout_s, ca)
        """Asks it what has no method here: `server.http.get("/calibrations")`."""

    def close(self) -> None:
        """Close its connections."""
        self.http.close()

    @property
    def url(self) -> str:
        """Its address."""
        return self.http.url

    @property
    def headers(self) -> dict[str, str]:
        """What is shown with every question: the token, if there is one."""
        return dict(self.http.headers)

    def nodes(self) -> list[dict[str, Any]]:
        """All nodes that it knows, as the API describes them: `node`, `connected`, `tiles`, ..."""
        items: list[dict[str, Any]] = self.http.get("/nodes", has="items")["items"]
        return items

    def node(self, name: str) -> dict[str, Any]:
        """One node."""
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
    ) -> Iterator[Session]:
        """Sessions, the newest first, page after page as they are taken.

        Args:
            search: text in name, subject, notes, tags or node.
            node: of this node only, or of one of these.
            tag: with this tag only, or with each of these.
            take: of this take only.
            since: recorded at this instant or later; one without a zone is of this machine's zone.
            until: recorded before this instant.
            complete: True, False or "lossy".
        """
        query: dict[str, object] = {
            "q": search,
            "node": _all_of(node),
            "tag": _all_of(tag),
            "take": take,
            "from": _instant(since),
            "to": _instant(until),
            "complete": complete,
            "limit": _PAGE,
        }
        while True:
            page = self.http.get("/sessions", query, has="next_cursor")
            for facts in page["items"]:
                yield Session(self.http, facts)
            if page["next_cursor"] is None:
                return
            query["cursor"] = page["next_cursor"]

    def session(self, session_id: str) -> Session:
        """One session."""
        return Session(
            self.http, self.http.get(f"/sessions/{quote(session_id, safe='')}", has="id")
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
        """All sessions of a take as one file, on the server's axis of time.

        Args:
            take: `Session.take`.
            path: of the file, which appears whole or not at all.
            format: one that holds several: `c3d`, `opensim`, `mcap`, `mat`, `xdf`.
            start_s: from so many seconds after each session's first frame on; None: all.
            end_s: before so many seconds; None: to the end.

        Raises:
            ConflictError: one of them is not sealed.
            UsageError: the format holds one session only, or one cannot be in it.
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
    ) -> Session:
        """Begin to record a node, or so many seconds earlier. Sent twice, it is begun once.

        Use the session as a context manager to have it stopped.
        """
        body: dict[str, object] = {"node": node, "name": name, "pre_roll_s": float(pre_roll_s)}
        body |= {"subject": subject, "notes": notes, "tags": list(tags)}
        key = {"Idempotency-Key": uuid.uuid4().hex}
        return Session(
            self.http, self.http.send("POST", "/sessions", body, headers=key, again=True)
        )

    def tare(self, node: str, reason: str = "") -> dict[str, Any]:
        """Take the newest unloaded quarter of a second of the last ten seconds as the baseline.

        Raises:
            ConflictError: the foot is loaded or moves, or the node is away.
        """
        return self.http.send("POST", f"/nodes/{quote(node, safe='')}/tare", {"reason": reason})

    def tares(self, node: str) -> list[dict[str, Any]]:
        """The tares of a node, the newest first."""
        path = f"/nodes/{quote(node, safe='')}/tares"
        items: list[dict[str, Any]] = self.http.get(path, has="items")["items"]
        return items

    def ticket(self, *, role: str = "operator") -> dict[str, Any]:
        """Return an invite for an `operator` or a `viewer`; this needs the server's token."""
        return self.http.send("POST", "/tickets", {"role": role})

    def live(
        self,
        node: str | None = None,
        columns: Sequence[str] = (),
        *,
        policy: Policy = "lossless",
        stream_id: str | None = None,
        from_seq: int | None = None,
        on_loss: Callable[[Loss], None] | None = None,
        give_up_s: float | None = None,
    ) -> Live:
        """Every frame of a node with its estimates, as Arrow batches, from now or from a frame on.

        Args:
            node: its name; None: the only one there is.
            columns: of all tiles (`force_n`) or one (`force_n_0`); none: all.
            policy: `lossless`: every frame once, over broken links and restarts of the server;
                `drop_oldest`: what you are 2 s late for is left out; `latest`: the newest only.
            stream_id: with `first_seq`, the stream to begin in, as in `Live.position`.
            from_seq: the frame to begin with.
            on_loss: told of frames that are left out; None: for `lossless` a `FramesLostWarning`,
                and all are in `Live.losses`.
            give_up_s: raise `NoAnswerError` if the server does not answer for so long; None: never,
                once it has answered.
        """
        asked = Asked.of(self.http.url, node, columns, policy, stream_id, from_seq)
        return Live(asked, self.http, on_loss=on_loss, give_up_s=give_up_s)


def _all_of(given: str | Sequence[str] | None) -> list[str]:
    return [given] if isinstance(given, str) else list(given or ())


def _instant(given: datetime | str | None) -> str | None:
    if isinstance(given, datetime):
        return given.astimezone().isoformat()
    return given
