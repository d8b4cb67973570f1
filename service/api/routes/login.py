"""Login: a ticket, or the token, is exchanged for a cookie of the browser."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Request, Response
from pydantic import Field, StringConstraints
from starlette.exceptions import HTTPException

from devices.clock import server_utc_ns
from devices.types import StrictModel
from service.api.access import LOGIN_S, TICKET_S, Logins, Role, cookie_name
from service.api.routes.common import NO_CONTENT
from service.protocol.live import View

router = APIRouter(tags=["login"])

_INVALID_TICKET = (
    "Invalid ticket: each is valid once and for five minutes, until the server ends. Get "
    "a new one with `foottile invite` on the computer on which `foottile serve` runs"
)
_NO_CREDENTIALS = "A login needs a ticket, or the token as Authorization: Bearer TOKEN"

RoleName = Literal["viewer", "operator"]
_ROLES: dict[str, Role] = {"viewer": Role.VIEWER, "operator": Role.OPERATOR}


class LoginView(View):
    """Present permissions of the client."""

    private: bool = Field(description="True: reading needs a login, too.")
    role: RoleName | None = Field(
        description="Role by the credentials of the request; null: none. Without any, reading is "
        "allowed unless the server is private."
    )
    ended: bool = Field(description="True: the login has expired.")
    ends_t_ns: int | None = Field(description="End of the login, server's UTC.")


class LogIn(StrictModel):
    """Ticket of a login; the token is sent as `Authorization` instead."""

    ticket: Annotated[str, StringConstraints(max_length=100)] | None = None


class NewTicket(StrictModel):
    """Role of a new ticket."""

    role: RoleName = Field(default="operator", description="Role of the login.")


class TicketView(View):
    """Ticket, a one-time login."""

    ticket: str
    role: RoleName
    ends_t_ns: int = Field(description="End of its validity, server's UTC.")
    urls: list[str] = Field(
        description="URLs of the live page with the ticket; the first browser that opens one is "
        "logged in.",
        examples=[["http://192.168.4.1:8000/#ticket=..."]],
    )


def _logins(request: Request) -> Logins:
    logins: Logins = request.app.state.logins
    return logins


LoginsState = Annotated[Logins, Depends(_logins)]


@router.get("/login", summary="Current permissions")
async def get_login(request: Request, logins: LoginsState) -> LoginView:
    """Return the permissions by the cookie or the token of this request."""
    credentials = logins.check_credentials(request)
    return _make_view(
        logins, credentials.role, credentials.cookie_remaining_s, has_ended=credentials.is_expired
    )


@router.post("/login", summary="Exchange a ticket, or the token, for a cookie")
async def log_in(
    body: LogIn, request: Request, response: Response, logins: LoginsState
) -> LoginView:
    """Set a cookie, HttpOnly and SameSite=Strict, valid for 12 hours or until the server ends."""
    if body.ticket is not None:
        grant = logins.tickets.redeem(body.ticket)
        right = None if grant is None else grant.role
    else:
        credentials = logins.check_credentials(request)
        # A cookie cannot renew itself: it would never expire.
        right = Role.OPERATOR if credentials.role is Role.OWNER else None
    if right is None:
        detail = _INVALID_TICKET if body.ticket is not None else _NO_CREDENTIALS
        headers = {"www-authenticate": "Bearer"}
        raise HTTPException(HTTPStatus.UNAUTHORIZED, detail, headers)
    response.set_cookie(
        cookie_name(request),
        logins.cookies.create(right),
        max_age=int(LOGIN_S),
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return _make_view(logins, right, LOGIN_S)


@router.delete("/login", summary="Log out", **NO_CONTENT)
async def log_out(request: Request, response: Response, logins: LoginsState) -> None:
    """Invalidate the cookie of this request."""
    cookie = logins.read_cookie(request)
    if cookie is not None:
        logins.cookies.redeem(cookie)
        response.delete_cookie(cookie_name(request), httponly=True, samesite="strict")


@router.post("/tickets", summary="Create a one-time login", status_code=HTTPStatus.CREATED)
async def create_invite(body: NewTicket, request: Request, logins: LoginsState) -> TicketView:
    """Create a ticket, valid once and for five minutes. Needs the token; a login is not enough."""
    ticket = logins.tickets.create(_ROLES[body.role])
    urls = request.app.state.find_urls() or (str(request.base_url).rstrip("/"),)
    return TicketView(
        ticket=ticket,
        role=body.role,
        ends_t_ns=server_utc_ns() + round(TICKET_S * 1e9),
        urls=[add_ticket(url, ticket) for url in urls],
    )


def add_ticket(url: str, ticket: str) -> str:
    """Return the page's URL with a ticket in the fragment, which no browser sends to a server."""
    return f"{url}/#ticket={ticket}"


def _make_view(
    logins: Logins, right: Role | None, left_s: float | None, *, has_ended: bool = False
) -> LoginView:
    return LoginView(
        private=logins.is_private,
        role=None if right is None else "viewer" if right is Role.VIEWER else "operator",
        ended=has_ended,
        ends_t_ns=None if left_s is None else server_utc_ns() + round(left_s * 1e9),
    )
