"""HTTP client of a server: requests, and errors for its problem responses."""

from __future__ import annotations

import json
import os
import ssl
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

from foottile.connection import (
    explain_foreign_response,
    explain_tls,
    make_context,
    make_local_context,
)
from foottile.environment import check_token, decode_zone, read_token
from foottile.errors import ClientError, InvalidRequestError, ServerUnavailableError, make_error
from foottile.local_server import find_local_server

try:
    import httpx
except ModuleNotFoundError as error:  # a node does not need it
    raise InvalidRequestError("foottile needs httpx: pip install 'foottile[client]'") from error

API = "/api/v1"
_ATTEMPTS_MAX = 2


class HttpClient:
    """Thread-safe HTTP client of one server.

    Args:
        url: address of the server.
        token: its token; None: FOOTTILE_TOKEN, else the token of this user's server on this
            machine.
        timeout_s: timeout of a request.
        ca: file or folder of further CA certificates, beside the machine's.

    Raises:
        InvalidRequestError: invalid address, token or certificate.
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
        token = check_token(token, "the token") if token else read_token()
        local = find_local_server(self.url)
        if local is not None and (token is None or local.ca):
            self.url, token = local.url, token or local.token
        is_tls = self.url.startswith("https:")
        self.context = make_context(ca) if is_tls else None
        """Trusted CAs; None without TLS."""
        if local is not None and local.ca and ca is None:
            self.context = make_local_context(local.ca)
        if ca is not None and self.context is None:
            raise InvalidRequestError(f"{self.url}: a CA is for addresses with https://")
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
            raise InvalidRequestError(f"{url!r} is no server address: {error}") from error
        if self._client.base_url.scheme not in ("http", "https") or not self._client.base_url.host:
            raise InvalidRequestError(f"{url!r} is no server address; expected http://HOST:PORT")

    def close(self) -> None:
        """Close all connections."""
        self._client.close()

    def get(
        self, path: str, query: Mapping[str, object] | None = None, *, field: str = ""
    ) -> dict[str, Any]:
        """Return a JSON resource.

        Args:
            path: path below `/api/v1`.
            query: parameters; None values are omitted, a list repeats its name.
            field: field that every valid response has.

        Raises:
            ClientError: no response, or a problem response.
        """
        content = self._request("GET", path, _ATTEMPTS_MAX, params=_encode_query(query))
        if field and field not in content:
            raise ServerUnavailableError(
                f"{self.url}: the answer to {API}{path} has no {field!r}; expected a foottile "
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
        is_idempotent: bool = False,
    ) -> dict[str, Any]:
        """Send a change and return the JSON response.

        Args:
            method: POST, PUT, PATCH or DELETE.
            path: path below `/api/v1`.
            body: JSON content; None values are omitted.
            headers: further headers.
            is_idempotent: send it again if the first response is lost.

        Raises:
            ClientError: no response, or a problem response.
        """
        content = None if body is None else {k: v for k, v in body.items() if v is not None}
        attempts = _ATTEMPTS_MAX if is_idempotent else 1
        return self._request(method, path, attempts, json=content, headers=dict(headers or {}))

    @contextmanager
    def stream(
        self,
        path: str,
        query: Mapping[str, object] | None = None,
        *,
        headers: Mapping[str, str] | None = None,
    ) -> Iterator[httpx.Response]:
        """Yield a response whose content is read in chunks.

        Args:
            path: path below `/api/v1`.
            query: as for `get`.
            headers: further headers.

        Raises:
            ClientError: no response, a problem response, or an interrupted one.
        """
        has_response = False
        try:
            with self._client.stream(
                "GET", path, params=_encode_query(query), headers=dict(headers or {})
            ) as response:
                has_response = True
                self._check_origin(response)
                if response.is_error:
                    response.read()
                    raise self._make_error(response)
                yield response
        except httpx.HTTPError as error:
            if has_response:
                text = f"{self.url}: the answer broke off: {error}."
                raise ServerUnavailableError(text) from error
            raise self._make_unavailable_error(error) from error

    def _request(self, method: str, path: str, attempts: int, **options: Any) -> dict[str, Any]:
        if self._client.is_closed:
            raise InvalidRequestError(f"{self.url}: this connection was closed; make a new one")
        while True:
            attempts -= 1
            try:
                response = self._client.request(method, path, **options)
                break
            except httpx.TransportError as error:
                if attempts <= 0 or isinstance(error, httpx.TimeoutException):
                    raise self._make_unavailable_error(error) from error
            except httpx.HTTPError as error:
                raise self._make_unavailable_error(error) from error
        self._check_origin(response)
        if response.is_error:
            raise self._make_error(response)
        if response.status_code == HTTPStatus.NO_CONTENT:
            return {}
        content = _parse_json(response)
        if not isinstance(content, dict):
            self._check_origin(response, expected="JSON")
        assert isinstance(content, dict)  # noqa: S101  # `_check_origin` raises otherwise
        return content

    def _check_origin(self, response: httpx.Response, *, expected: str = "") -> None:
        """Reject a response of another program."""
        status, headers = response.status_code, dict(response.headers)
        problem = explain_foreign_response(str(response.url), status, headers, expected=expected)
        if problem is not None:
            raise ServerUnavailableError(f"{self.url}: {problem}", status=status)

    def _make_error(self, response: httpx.Response) -> ClientError:
        reason = f"{response.reason_phrase} (HTTP {response.status_code})"
        return make_error(response.status_code, _parse_json(response), self.url, otherwise=reason)

    def _make_unavailable_error(self, error: Exception) -> ServerUnavailableError:
        if (tls_problem := explain_tls(error)) is not None:
            return ServerUnavailableError(f"{self.url}: {tls_problem}")
        reason = str(error) or type(error).__name__
        text = f"{self.url}: no answer: {reason}. Is `foottile serve` running there?"
        return ServerUnavailableError(text)


def _parse_json(response: httpx.Response) -> object:
    try:
        content: object = json.loads(response.content)
    except ValueError:
        return None
    return content


def _encode_query(query: Mapping[str, object] | None) -> dict[str, str | list[str]]:
    return {
        name: [_encode(each) for each in value] if isinstance(value, list) else _encode(value)
        for name, value in (query or {}).items()
        if value is not None
    }


def _encode(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
