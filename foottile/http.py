"""Questions to a server over HTTP, and what is wrong with its answers."""

from __future__ import annotations

import json
import os
import ssl
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

from foottile.address import decode_zone
from foottile.environment import check_token, read_token
from foottile.errors import FootTileError, NoAnswerError, UsageError, refused
from foottile.foreign import explain_foreign
from foottile.local_server import find_local_server
from foottile.tls import explain_tls, make_context

try:
    import httpx
except ModuleNotFoundError as error:  # a node needs none
    raise UsageError("foottile needs httpx: pip install 'foottile[client]'") from error

API = "/api/v1"
_TRIES = 2


class Http:
    """One server over HTTP; may be used from several threads.

    Args:
        url: its address.
        token: its token; None: FOOTTILE_TOKEN, else that of this user's server on this machine.
        timeout_s: how long an answer may keep one waiting.
        ca: file or folder of CA certificates, beside those that the machine trusts.

    Raises:
        UsageError: that is no address, token or certificate.
    """

    def __init__(
        self,
        url: str,
        token: str | None,
        timeout_s: float,
        ca: str | os.PathLike[str] | None = None,
    ) -> None:
        scheme, separator, rest = decode_zone(url.strip().rstrip("/")).partition("://")
        self.url = scheme.lower() + separator + rest
        self.context = make_context(ca) if self.url.startswith("https:") else None
        """Whom it trusts, if it is asked with TLS."""
        if ca is not None and self.context is None:
            raise UsageError(f"{self.url}: a CA is for addresses with https://")
        token = check_token(token, "the token") if token else read_token()
        if token is None and (local := find_local_server(self.url)) is not None:
            self.url, token = local.url, local.token
        self.headers = {"Authorization": f"Bearer {token}"} if token else {}
        try:
            self._client = httpx.Client(
                base_url=self.url + API,
                headers=[(name.encode(), v.encode()) for name, v in self.headers.items()],
                timeout=timeout_s,
                trust_env=False,
                verify=self.context or ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT),
            )
        except (httpx.InvalidURL, ValueError) as error:
            raise UsageError(f"{url!r} is no server address: {error}") from error
        if self._client.base_url.scheme not in ("http", "https") or not self._client.base_url.host:
            raise UsageError(f"{url!r} is no server address; expected http://HOST:PORT")

    def close(self) -> None:
        """Close its connections."""
        self._client.close()

    def get(
        self, path: str, query: Mapping[str, object] | None = None, *, has: str = ""
    ) -> dict[str, Any]:
        """Ask for JSON.

        Args:
            path: behind `/api/v1`.
            query: what is None is left out, and of a list each is asked for.
            has: a field that the answer of a foottile server has.

        Raises:
            FootTileError: no answer, or one that is a problem.
        """
        content = self._asked("GET", path, _TRIES, params=_given(query))
        if has and has not in content:
            raise NoAnswerError(
                f"{self.url}: the answer to {API}{path} has no {has!r}; expected a foottile "
                "server's. Another program may have this address"
            )
        return content

    def send(
        self,
        method: str,
        path: str,
        body: Mapping[str, object] | None = None,
        *,
        headers: Mapping[str, str] | None = None,
        again: bool = False,
    ) -> dict[str, Any]:
        """Change something.

        Args:
            method: POST, PATCH or DELETE.
            path: behind `/api/v1`.
            body: as JSON; what is None is left out.
            headers: further ones.
            again: may it be sent twice, if there was no answer the first time?

        Raises:
            FootTileError: no answer, or one that is a problem.
        """
        given = None if body is None else {k: v for k, v in body.items() if v is not None}
        tries = _TRIES if again else 1
        return self._asked(method, path, tries, json=given, headers=dict(headers or {}))

    @contextmanager
    def stream(
        self,
        path: str,
        query: Mapping[str, object] | None = None,
        *,
        headers: Mapping[str, str] | None = None,
    ) -> Iterator[httpx.Response]:
        """An answer whose content is read in pieces.

        Args:
            path: behind `/api/v1`.
            query: as of `get`.
            headers: further ones.

        Raises:
            FootTileError: no answer, one that is a problem, or one that broke off.
        """
        has_begun = False
        try:
            with self._client.stream(
                "GET", path, params=_given(query), headers=dict(headers or {})
            ) as answer:
                has_begun = True
                self._check_ours(answer)
                if answer.is_error:
                    answer.read()
                    raise self._problem(answer)
                yield answer
        except httpx.HTTPError as error:
            if has_begun:
                raise NoAnswerError(f"{self.url}: the answer broke off: {error}.") from error
            raise self._no_answer(error) from error

    def _asked(self, method: str, path: str, tries: int, **how: Any) -> dict[str, Any]:
        if self._client.is_closed:
            raise UsageError(f"{self.url}: this connection was closed; make a new one")
        while True:
            tries -= 1
            try:
                answer = self._client.request(method, path, **how)
                break
            except httpx.TransportError as error:
                if tries <= 0 or isinstance(error, httpx.TimeoutException):
                    raise self._no_answer(error) from error
            except httpx.HTTPError as error:
                raise self._no_answer(error) from error
        self._check_ours(answer)
        if answer.is_error:
            raise self._problem(answer)
        if answer.status_code == HTTPStatus.NO_CONTENT:
            return {}
        content = _json(answer)
        if not isinstance(content, dict):
            self._check_ours(answer, expected="JSON")
        assert isinstance(content, dict)  # noqa: S101  # else the line above has raised
        return content

    def _check_ours(self, answer: httpx.Response, *, expected: str = "") -> None:
        """Refuse an answer that is another program's."""
        status, headers = answer.status_code, dict(answer.headers)
        foreign = explain_foreign(str(answer.url), status, headers, expected=expected)
        if foreign is not None:
            raise NoAnswerError(f"{self.url}: {foreign}", status=status)

    def _problem(self, answer: httpx.Response) -> FootTileError:
        reason = f"{answer.reason_phrase} (HTTP {answer.status_code})"
        return refused(answer.status_code, _json(answer), self.url, otherwise=reason)

    def _no_answer(self, error: Exception) -> NoAnswerError:
        if (of_tls := explain_tls(error)) is not None:
            return NoAnswerError(f"{self.url}: {of_tls}")
        said = str(error) or type(error).__name__
        return NoAnswerError(f"{self.url}: no answer: {said}. Is `foottile serve` running there?")


def _json(answer: httpx.Response) -> object:
    try:
        content: object = json.loads(answer.content)
    except ValueError:
        return None
    return content


def _given(query: Mapping[str, object] | None) -> dict[str, str | list[str]]:
    return {
        name: [_text(each) for each in value] if isinstance(value, list) else _text(value)
        for name, value in (query or {}).items()
        if value is not None
    }


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
