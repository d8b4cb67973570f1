"""Getting in: a ticket, or the token, becomes a cookie that the browser keeps."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Request, Response
from pydantic import BaseModel, ConfigDict, Field, StringConstraints
from starlette.exceptions import HTTPException

from service.api.logins import LOGIN_S, TICKET_S, Logins, Right, cookie_name
from service.server.screens.views import View
from service.server_clock import utc_ns

router = APIRouter(tags=["login"])

_NOT_TAKEN = (
    "This ticket is not taken: each is good once and for five minutes, until the server ends. Get "
    "a new one with `foottile invite` on the computer on which `foottile serve` runs"
)
_NOTHING_SHOWN = "A login needs a ticket, or the token as Authorization: Bearer TOKEN"

May = Literal["look", "press"]
_RIGHTS: dict[str, Right] = {"look": Right.LOOK, "press": Right.PRESS}


class LoginView(View):
    """What the one who asks may do."""

    private: bool = Field(description="Is a login asked for to look, too?")
    may: May | None = Field(
        description="By the login that was shown; null: none was. Then one may look unless the "
        "server is private."
    )
    ended: bool = Field(description="Was a login shown that has ended?")
    ends_t_ns: int | None = Field(description="When the login ends, server's UTC.")


class LogIn(BaseModel):
    """With what to get in; the token comes as `Authorization` instead."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    ticket: Annotated[str, StringConstraints(max_length=100)] | None = None


class NewTicket(BaseModel):
    """What a ticket is for."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    may: May = Field(default="press", description="`look`: a viewer's.")


class TicketView(View):
    """A ticket."""

    ticket: str
    may: May
    ends_t_ns: int = Field(description="When it ends, server's UTC.")
    urls: list[str] = Field(
        description="Addresses of the live page, with the ticket; whoever opens one first is in.",
        examples=[["http://192.168.4.1:8000/#ticket=..."]],
    )


def _logins(request: Request) -> Logins:
    logins: Logins = request.app.state.logins
    return logins


LoginsState = Annotated[Logins, Depends(_logins)]


@router.get("/login", operation_id="getLogin", summary="What may I do?")
async def get_login(request: Request, logins: LoginsState) -> LoginView:
    """By the cookie or the token of this request."""
    shown = logins.shown_by(request)
    return _view(logins, shown.right, shown.left_s, has_ended=shown.has_ended)


@router.post("/login", operation_id="logIn", summary="Change a ticket, or the token, for a cookie")
async def log_in(
    body: LogIn, request: Request, response: Response, logins: LoginsState
) -> LoginView:
    """The cookie is HttpOnly and SameSite=Strict, and ends after 12 hours or with the server."""
    if body.ticket is not None:
        given = logins.tickets.take(body.ticket)
        right = None if given is None else given.right
    else:
        shown = logins.shown_by(request)
        # A cookie is not renewed by itself: then it would never end.
        right = Right.PRESS if shown.right is Right.OWN else None
    if right is None:
        detail = _NOT_TAKEN if body.ticket is not None else _NOTHING_SHOWN
        headers = {"www-authenticate": "Bearer"}
        raise HTTPException(HTTPStatus.UNAUTHORIZED, detail, headers)
    response.set_cookie(
        cookie_name(request),
        logins.cookies.new(right),
        max_age=int(LOGIN_S),
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return _view(logins, right, LOGIN_S)


@router.delete(
    "/login",
    operation_id="logOut",
    summary="Log out",
    status_code=HTTPStatus.NO_CONTENT,
    response_model=None,
)
async def log_out(request: Request, response: Response, logins: LoginsState) -> None:
    """The cookie of this request is good for nothing from now on."""
    cookie = logins.cookie_of(request)
    if cookie is not None:
        logins.cookies.take(cookie)
        response.delete_cookie(cookie_name(request), httponly=True, samesite="strict")


@router.post(
    "/tickets",
    operation_id="giveTicket",
    summary="A ticket for somebody else",
    status_code=HTTPStatus.CREATED,
)
async def give_ticket(body: NewTicket, request: Request, logins: LoginsState) -> TicketView:
    """Good once, for five minutes. It takes the token itself; a login is not enough."""
    ticket = logins.tickets.new(_RIGHTS[body.may])
    urls = request.app.state.find_urls() or (str(request.base_url).rstrip("/"),)
    return TicketView(
        ticket=ticket,
        may=body.may,
        ends_t_ns=utc_ns() + round(TICKET_S * 1e9),
        urls=[with_ticket(url, ticket) for url in urls],
    )


def with_ticket(url: str, ticket: str) -> str:
    """The page's address with a ticket, in the part that no browser sends to a server."""
    return f"{url}/#ticket={ticket}"


def _view(
    logins: Logins, right: Right | None, left_s: float | None, *, has_ended: bool = False
) -> LoginView:
    return LoginView(
        private=logins.is_private,
        may=None if right is None else "look" if right is Right.LOOK else "press",
        ended=has_ended,
        ends_t_ns=None if left_s is None else utc_ns() + round(left_s * 1e9),
    )
