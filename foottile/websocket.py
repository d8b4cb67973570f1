"""Websockets of a client that follows no redirect: it would show its token to whoever sends one."""

from __future__ import annotations

from typing import Any

from websockets.asyncio.client import ClientConnection as AsyncClientConnection
from websockets.exceptions import InvalidHandshake, InvalidStatus
from websockets.http11 import Response
from websockets.sync.client import ClientConnection


class UpgradeRefused(InvalidHandshake):
    """An HTTP answer came in place of a websocket.

    Attributes:
        status: of the answer.
        headers: of the answer, their names in small letters.
        body: what came with it.
    """

    def __init__(self, response: Response) -> None:
        super().__init__(f"HTTP {response.status_code}")
        self.status = response.status_code
        self.headers = {name.lower(): value for name, value in response.headers.raw_items()}
        self.body = bytes(response.body or b"")


class Connection(ClientConnection):
    """A websocket read by a thread; for `create_connection` of `websockets.sync`."""

    def handshake(self, *given: Any, **options: Any) -> None:
        """Ask for the websocket.

        Raises:
            UpgradeRefused: an HTTP answer came.
        """
        try:
            super().handshake(*given, **options)
        except InvalidStatus as error:
            raise UpgradeRefused(error.response) from error


class AsyncConnection(AsyncClientConnection):
    """A websocket of an event loop; for `create_connection` of `websockets.asyncio`."""

    async def handshake(self, *given: Any, **options: Any) -> None:
        """Ask for the websocket.

        Raises:
            UpgradeRefused: an HTTP answer came.
        """
        try:
            await super().handshake(*given, **options)
        except InvalidStatus as error:
            raise UpgradeRefused(error.response) from error
