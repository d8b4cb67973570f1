"""Websocket clients that follow no redirect: a redirect could steal the token."""

from __future__ import annotations

from typing import Any

from websockets.asyncio.client import ClientConnection as AsyncClientConnection
from websockets.exceptions import InvalidHandshake, InvalidStatus
from websockets.http11 import Response
from websockets.sync.client import ClientConnection


class UpgradeRejection(InvalidHandshake):
    """HTTP response in place of a websocket.

    Attributes:
        status: HTTP status.
        headers: headers, with names in lower case.
        body: content.
    """

    def __init__(self, response: Response) -> None:
        super().__init__(f"HTTP {response.status_code}")
        self.status = response.status_code
        self.headers = {name.lower(): value for name, value in response.headers.raw_items()}
        self.body = bytes(response.body or b"")


class Websocket(ClientConnection):
    """Websocket for threads, as `create_connection` of `websockets.sync`."""

    def handshake(self, *args: Any, **options: Any) -> None:
        """Perform the websocket handshake.

        Raises:
            UpgradeRejection: the server sent an HTTP response.
        """
        try:
            super().handshake(*args, **options)
        except InvalidStatus as error:
            raise UpgradeRejection(error.response) from error


class AsyncWebsocket(AsyncClientConnection):
    """Websocket for an event loop, as `create_connection` of `websockets.asyncio`."""

    async def handshake(self, *args: Any, **options: Any) -> None:
        """Perform the websocket handshake.

        Raises:
            UpgradeRejection: the server sent an HTTP response.
        """
        try:
            await super().handshake(*args, **options)
        except InvalidStatus as error:
            raise UpgradeRejection(error.response) from error
