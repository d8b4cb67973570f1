"""What a live stream is apart from its socket: its protocol, its clock, how it is connected."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from websockets.exceptions import ConnectionClosed

from foottile.http import Http
from foottile.live_protocol import MESSAGE_BYTES_MAX, Asked, LiveProtocol, Loss
from foottile.websocket import UpgradeRefused

_NO_CLOSE_FRAME = 1006


class LiveState:
    """Base of live streams, with threads and with asyncio."""

    def __init__(
        self,
        asked: Asked,
        http: Http,
        *,
        on_loss: Callable[[Loss], None] | None = None,
        give_up_s: float | None = None,
    ) -> None:
        self._protocol = LiveProtocol(asked, on_loss)
        self._http = http
        self._give_up_s = give_up_s
        self._heard_s = time.monotonic()
        self._is_over = False

    @property
    def position(self) -> tuple[str, int] | None:
        """`stream_id` and `first_seq` of the frame that is wanted next; None before the first."""
        return self._protocol.position

    @property
    def losses(self) -> Sequence[Loss]:
        """What was left out, as far as it was said; the newest thousand."""
        return tuple(self._protocol.losses)

    def _options(self) -> dict[str, Any]:
        """How a connection is made."""
        return {
            "additional_headers": self._http.headers,
            "ssl": self._http.context,
            "compression": None,
            "max_size": MESSAGE_BYTES_MAX,
            "close_timeout": 1.0,
            "proxy": None,
        }

    def _closed_s(self, end: ConnectionClosed) -> float:
        """How long to wait after a connection has ended.

        Raises:
            FootTileError: it is not to be opened again.
        """
        if self._is_over:
            return 0.0
        code, reason = _NO_CLOSE_FRAME, ""
        if end.rcvd is not None:
            code, reason = end.rcvd.code, end.rcvd.reason
        self._protocol.closed(int(code), reason)
        return self._again_s(end)

    def _failed_s(self, error: Exception) -> float:
        """How long to wait after none could be made.

        Raises:
            FootTileError: it is not to be tried again.
        """
        if isinstance(error, UpgradeRefused):
            problem = self._protocol.refused(error.status, error.headers, error.body)
            if problem is not None:
                raise problem from error
        return self._again_s(error)

    def _again_s(self, error: Exception) -> float:
        silent_s = time.monotonic() - self._heard_s
        return self._protocol.again_s(error, silent_s, self._give_up_s)
