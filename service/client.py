"""A client of the REST API: lists sessions, downloads them verified, whole or a slice."""

from __future__ import annotations

import json
import os
import re
from http import HTTPStatus
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

import httpx

from devices.errors import DamagedFileError, LinkError, StateError, UsageError
from storage.checked_json import read_checked, write_checked
from storage.checked_table import table_of
from storage.durable import (
    LOCK_NAME,
    set_aside,
    storage_errors,
    sync_folder,
    temporary_of,
    write_whole,
)
from storage.file_hash import sha256_of
from storage.formats.options import NO_OPTIONS, FormatOptions
from storage.formats.slice import Slice
from storage.formats.written.format import Format
from storage.sessions.choice import Choice
from storage.sessions.claims import SESSION_NAME
from storage.sessions.folder import FRAMES_NAME
from storage.verify.exported import FORMATS as PROVEN
from storage.verify.exported import verify_export

API = "/api/v1"
_CHUNK = 1 << 20
_PARQUET = b"PAR1"

Query = dict[str, str | list[str]]


def _query_of(choice: Choice) -> Query:
    said = {
        "node": list(choice.nodes),
        "tag": list(choice.tags),
        "take": choice.take,
        "q": choice.q,
        "from": choice.from_t_ns,
        "to": choice.to_t_ns,
        "complete": None if choice.complete is None else str(choice.complete).lower(),
    }
    return {
        name: value if isinstance(value, list) else str(value)
        for name, value in said.items()
        if value not in (None, [])
    }


def refuse_data_folder(folder: Path) -> None:
    """Refuse to write where a server or node keeps this session, or others.

    What was pulled before is written again; its `session.json` is set aside if it is damaged.

    Args:
        folder: of one session, perhaps not there yet.

    Raises:
        UsageError: it is theirs.
        StorageError: what is damaged cannot be set aside.
    """
    remedy = "Choose a folder of your own with --out"
    for place in (folder.resolve(), *folder.resolve().parents[:4]):
        has_data = (place / "sessions").is_dir() or (place / "journal").is_dir()
        if has_data and (place / LOCK_NAME).exists():
            what = "this is a data folder, whose files are its server's or node's"
            raise UsageError(what, where=str(place), remedy=remedy)
    path = folder / SESSION_NAME
    try:
        content = json.loads(read_checked(path).text)
    except FileNotFoundError:
        return
    except ValueError:  # a DamagedFileError is one
        set_aside(path)
        return
    if not isinstance(content, dict) or "complete" not in content:
        what = f"its {SESSION_NAME} is not one that `foottile pull` wrote"
        raise UsageError(what, where=str(folder), remedy=remedy)


class Client:
    """One server. Use as a context manager.

    Args:
        server: its address.
        token: its token; None: FOOTTILE_TOKEN, if that is set.

    Raises:
        UsageError: that is no address.
    """

    def __init__(self, server: str, token: str | None = None) -> None:
        self.server = server.rstrip("/")
        token = token or os.environ.get("FOOTTILE_TOKEN")
        headers = [(b"Authorization", f"Bearer {token}".encode())] if token else []
        try:
            self._http = httpx.Client(
                base_url=self.server + API, headers=headers, timeout=10.0, trust_env=False
            )
        except (httpx.InvalidURL, ValueError) as error:
            raise UsageError(f"{server!r} is no server address: {error}") from error
        if self._http.base_url.scheme not in ("http", "https"):
            raise UsageError(f"{server!r} is no server address", expected="http://HOST:PORT")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def sessions(self, choice: Choice | None = None) -> list[dict[str, Any]]:
        """Sessions, newest first.

        Args:
            choice: which; None: all.

        Raises:
            LinkError: the server does not answer, or not as one of ours.
        """
        asked = {} if choice is None else _query_of(choice)
        found: list[dict[str, Any]] = []
        cursor: str | None = None
        while True:
            query = {"limit": "500", **asked} | ({"cursor": cursor} if cursor else {})
            page = self._get("/sessions", query)
            found += page["items"]
            cursor = page["next_cursor"]
            if cursor is None:
                return found

    def node(self, name: str) -> dict[str, Any]:
        """One node.

        Raises:
            LinkError: the server does not answer, or knows no such node.
        """
        return self._get(f"/nodes/{quote(name, safe='')}")

    def session(self, session_id: str) -> dict[str, Any]:
        """One session.

        Raises:
            LinkError: the server does not answer, or knows no such session.
            UsageError: that is no id.
        """
        return self._session(session_id)

    def start(self, node: str, name: str, *, pre_roll_s: float = 0.0) -> dict[str, Any]:
        """Begin to record a node, or so much earlier.

        Raises:
            LinkError: the server does not answer or refuses.
        """
        return self._post("/sessions", {"node": node, "name": name, "pre_roll_s": pre_roll_s})

    def stop(self, session_id: str) -> dict[str, Any]:
        """End a recording.

        Raises:
            LinkError: the server does not answer or refuses.
        """
        return self._post(f"/sessions/{quote(session_id, safe='')}/stop", None)

    def ticket(self, may: str) -> dict[str, Any]:
        """A ticket for somebody who may `look` or `press`.

        Raises:
            LinkError: the server does not answer or refuses.
        """
        return self._post("/tickets", {"may": may})

    def pull(self, session_id: str, out: Path) -> dict[str, Any]:
        """Download a sealed session into the folder `out`/`session_id`.

        Returns:
            Where it is, and what is known of it.

        Raises:
            LinkError: the server does not answer, the download broke off, or its hash is wrong.
            StateError: the session is not sealed.
            UsageError: that is a folder in which a server or node keeps its sessions.
            StorageError: it cannot be written.
        """
        session = self._session(session_id)
        if session["sha256"] is None:
            raise StateError(
                f"session {session_id} is {session['state']}"
                + (f": {session['problem']}" if session["problem"] else ""),
                expected="a sealed session",
                remedy="Stop it first, or wait until it is sealed",
            )
        folder = out / session_id
        refuse_data_folder(folder)
        with storage_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        path = folder / FRAMES_NAME
        resumed = 0
        if not (path.is_file() and sha256_of(path) == session["sha256"]):
            resumed = self._download(session, path)
        events = self._get(f"/sessions/{session_id}/events")
        ledger = self._get(f"/sessions/{session_id}/ledger")
        for name, content in (("session", session), ("events", events), ("ledger", ledger)):
            write_checked(folder / f"{name}.json", json.dumps(content, indent=1).encode())
        for name in ("events", "clock"):
            self._pull_table(f"/sessions/{session_id}/{name}", folder / f"{name}.parquet")
        return {**session, "path": str(path), "resumed_bytes": resumed}

    def pull_made(
        self,
        session_id: str,
        out: Path,
        part: Slice,
        to: Format,
        options: FormatOptions = NO_OPTIONS,
    ) -> dict[str, Any]:
        """Download a session, or some seconds or columns of it, in some format.

        It is one file in the folder `out`.

        The server reads, and sends, no more than that. A slice has no hash of its own: its pages'
        checksums prove it if it is Parquet, and its metadata say what it was made of.

        Returns:
            Where it is, and what is known of its session.

        Raises:
            LinkError: the server does not answer or refuses, or what came cannot be read.
            UsageError: that is a folder in which a server or node keeps its sessions.
            StorageError: it cannot be written.
        """
        session = self._session(session_id)
        path = self._pull_made(f"/sessions/{session_id}/data", session_id, out, part, to, options)
        return {**session, "path": str(path), "bytes": path.stat().st_size}

    def pull_take(
        self,
        take_id: str,
        out: Path,
        part: Slice,
        to: Format,
        options: FormatOptions = NO_OPTIONS,
    ) -> dict[str, Any]:
        """Download all sessions of a take, or some seconds of each, as one file in `out`.

        Returns:
            Where it is, and what is known of the take.

        Raises:
            LinkError: the server does not answer or refuses.
            UsageError: that is a folder in which a server or node keeps its sessions.
            StorageError: it cannot be written.
        """
        url = f"/takes/{quote(take_id, safe='')}"
        take = self._get(url)
        complete = "lossy" if any(s["complete"] == "lossy" for s in take["sessions"]) else True
        path = self._pull_made(f"{url}/data", f"take-{take['id']}", out, part, to, options)
        return {**take, "complete": complete, "path": str(path), "bytes": path.stat().st_size}

    def _pull_made(
        self, url: str, stem: str, out: Path, part: Slice, to: Format, options: FormatOptions
    ) -> Path:
        refuse_data_folder(out)
        with storage_errors(out):
            out.mkdir(parents=True, exist_ok=True)
        end = "end" if part.end_s is None else f"{part.end_s:g}s"
        path = out / f"{stem}_{part.start_s or 0.0:g}s-{end}.{to.ending}"
        query: dict[str, object] = {"format": to.name, "start_s": part.start_s, "end_s": part.end_s}
        query["columns"] = ",".join(part.columns) or None
        query |= options.model_dump(mode="json")
        asked = {name: str(value) for name, value in query.items() if value is not None}
        # Under a name of its own until it is proven: who is cut off begins anew.
        partial = temporary_of(path)
        try:
            self._write(url, asked, partial)
            # Of other formats the connection says whether they came to their end.
            report = verify_export(partial) if to.name in PROVEN else None
            if to.name in PROVEN and (report is None or report.problems):
                why = "it cannot be read" if report is None else report.problems[0]
                raise LinkError(
                    f"the slice did not come whole: {why}",
                    where=self.server,
                    remedy="Run the same command again",
                )
            with storage_errors(path):
                partial.replace(path)
                sync_folder(path.parent)
        finally:
            partial.unlink(missing_ok=True)
        return path

    def _write(self, url: str, query: dict[str, str], path: Path) -> None:
        """Write an answer to a file, on the disk."""
        try:
            with self._http.stream("GET", url, params=query) as answer:
                if answer.is_error:
                    answer.read()
                    raise self._refused(answer)
                with storage_errors(path), path.open("xb") as file:
                    for chunk in answer.iter_bytes(_CHUNK):
                        file.write(chunk)
                    file.flush()
                    os.fsync(file.fileno())
        except httpx.HTTPError as error:
            raise self._broken_off(error, "Run the same command again") from error

    def _session(self, session_id: str) -> dict[str, Any]:
        if not re.fullmatch(r"[0-9A-Za-z-]{1,64}", session_id):
            raise UsageError(
                f"{session_id!r} is no session id", remedy="List them with `foottile sessions`"
            )
        return self._get(f"/sessions/{session_id}")

    def _broken_off(self, error: httpx.HTTPError, remedy: str) -> LinkError:
        return LinkError(f"the download broke off: {error}", where=self.server, remedy=remedy)

    def _download(self, session: dict[str, Any], path: Path) -> int:
        """Download to a partial file that is kept if it breaks off; bytes that were there."""
        partial = path.with_name(f".{path.name}.part")
        have = partial.stat().st_size if partial.is_file() else 0
        headers = {"Accept-Encoding": "identity"}
        if have:
            headers |= {"Range": f"bytes={have}-", "If-Range": f'"{session["sha256"]}"'}
        url = f"/sessions/{session['id']}/data?format=parquet"
        try:
            with self._http.stream("GET", url, headers=headers) as answer:
                status = answer.status_code
                # All of it is here already, and only its name was lacking.
                is_here = bool(have) and status == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE
                if answer.is_error and not is_here:
                    answer.read()
                    raise self._refused(answer)
                resumed = have if is_here or status == HTTPStatus.PARTIAL_CONTENT else 0
                if not is_here:
                    with storage_errors(partial), partial.open("ab" if resumed else "wb") as file:
                        for chunk in answer.iter_bytes(_CHUNK):
                            file.write(chunk)
                        file.flush()
                        os.fsync(file.fileno())
        except httpx.HTTPError as error:
            again = "Run the same command again: it goes on where it stopped"
            raise self._broken_off(error, again) from error
        if sha256_of(partial) != session["sha256"]:
            partial.unlink()
            raise LinkError(
                "what was downloaded has not the hash that the server states",
                where=str(path),
                remedy="Run the same command again",
            )
        with storage_errors(path):
            partial.replace(path)
            sync_folder(path.parent)
        return resumed

    def _pull_table(self, url: str, path: Path) -> None:
        answer = self._answer(url, {"format": "parquet"})
        if answer.status_code == HTTPStatus.NOT_FOUND:
            return  # taken away, or an older server that has none
        if answer.is_error:
            raise self._refused(answer)
        if not answer.content.startswith(_PARQUET):
            return  # an older server, which knows no format but JSON here
        try:
            table_of(answer.content, where=path.name)
        except DamagedFileError as error:
            raise LinkError(
                str(error),
                where=self.server,
                remedy="Run the same command again; if it stays so, the server's file is damaged",
            ) from error
        write_whole(path, answer.content)

    def _get(self, path: str, query: Query | None = None) -> dict[str, Any]:
        return self._content(self._answer(path, query))

    def _post(self, path: str, body: dict[str, Any] | None) -> dict[str, Any]:
        try:
            answer = self._http.post(path, json=body)
        except httpx.HTTPError as error:
            raise self._no_answer(error) from error
        return self._content(answer)

    def _content(self, answer: httpx.Response) -> dict[str, Any]:
        if answer.is_error:
            raise self._refused(answer)
        try:
            content = answer.json()
        except ValueError:
            content = None
        if not isinstance(content, dict):
            raise LinkError("the answer is not a foottile server's", where=self.server)
        return content

    def _answer(self, path: str, query: Query | None) -> httpx.Response:
        try:
            return self._http.get(path, params=query)
        except httpx.HTTPError as error:
            raise self._no_answer(error) from error

    def _no_answer(self, error: httpx.HTTPError) -> LinkError:
        return LinkError(
            f"no answer: {error}",
            where=self.server,
            remedy="Is `foottile serve` running there? Name it with --server",
        )

    def _refused(self, answer: httpx.Response) -> LinkError:
        try:
            detail = str(answer.json()["detail"])
        except (ValueError, KeyError, TypeError):
            detail = answer.reason_phrase
        return LinkError(f"{detail} (HTTP {answer.status_code})", where=self.server)
