"""Page in plain HTTP from which a phone installs a server's CA, before it trusts anything else.

It serves this page and the CA's certificate, never a ticket, the token or data. Everything else is
redirected to the server with TLS.
"""

from __future__ import annotations

from html import escape
from http import HTTPStatus
from string import Template

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from service.api.access import SAFE_METHODS, parse_host
from service.api.app import find_page_folder
from service.api.certificates import CA_NAME
from service.api.settings import LimitSettings

LIMITS = LimitSettings(max_connections=32, max_connections_per_address=16, max_nodes=1)
_HEADERS = {
    "content-security-policy": "default-src 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
}


def make_ca_page(certificate: bytes, fingerprint: str, port: int) -> ASGIApp:
    """Build the application of the page.

    Args:
        certificate: the CA's, in PEM.
        fingerprint: its SHA-256.
        port: port of the server with TLS.
    """
    template = Template((find_page_folder() / "trust.html").read_text("utf-8"))

    def make_response(request: Request) -> Response:
        host = parse_host(request.headers.get("host", ""))
        if host is None:
            return Response(status_code=HTTPStatus.BAD_REQUEST, headers=_HEADERS)
        url = f"https://{host}:{port}"
        if request.method in SAFE_METHODS and request.url.path == "/":
            page = template.substitute(fingerprint=fingerprint, file=CA_NAME, url=escape(url))
            return Response(page, media_type="text/html", headers=_HEADERS)
        if request.method in SAFE_METHODS and request.url.path == f"/{CA_NAME}":
            return Response(certificate, media_type="application/x-x509-ca-cert", headers=_HEADERS)
        # Not for good: a laptop may serve plain HTTP on this port later.
        path, query = request.scope["raw_path"], request.scope["query_string"]
        target = f"{url}{(path + b'?' * bool(query) + query).decode('latin-1')}"
        return RedirectResponse(target, HTTPStatus.TEMPORARY_REDIRECT, headers=_HEADERS)

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close"})
        elif scope["type"] == "http":
            await make_response(Request(scope))(scope, receive, send)

    return answer
