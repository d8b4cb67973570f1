"""HEAD on every route: the answer of GET without its body.

Clients use it to check that something exists; some proxies and watchdogs use nothing else.
"""

from __future__ import annotations

from starlette.types import ASGIApp, Message, Receive, Scope, Send


class HeadFromGet:
    """ASGI middleware that answers HEAD on every route of GET.

    Args:
        app: application that answers GET.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        is_complete = False

        async def send_head(message: Message) -> None:
            nonlocal is_complete
            if message["type"] == "http.response.start":
                await send(message)
            elif not is_complete:
                # Once the answer is complete, `receive` reports a disconnect: files and exports
                # that are streamed are closed after their first piece.
                is_complete = True
                await send({"type": "http.response.body"})

        await self._app({**scope, "method": "GET"}, receive, send_head)
