"""State of a live stream without its socket: protocol, clock and connection options."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from websockets.exceptions import ConnectionClosed

from foottile.http import HttpClient
from foottile.live_protocol import MESSAGE_BYTES_MAX, FrameLoss, LiveProtocol, LiveRequest
from foottile.websocket import UpgradeRejection

_NO_CLOSE_FRAME = 1006


class LiveStreamState:
    """Base class of live streams for threads and for asyncio."""

    def __init__(
        self,
        request: LiveRequest,
        http: HttpClient,
        *,
        on_loss: Callable[[FrameLoss], None] | None = None,
        reconnect_timeout_s: float | None = None,
    ) -> None:
        self._protocol = LiveProtocol(request, on_loss)
        self._http = http
        self._reconnect_timeout_s = reconnect_timeout_s
        self._last_message_s = time.monotonic()
        self._is_closed = False

    @property
    def position(self) -> tuple[str, int] | None:
        """`stream_id` and `from_seq` of the next frame; None before the first."""
        return self._protocol.position

    @property
    def losses(self) -> Sequence[FrameLoss]:
        """Newest thousand losses that the server reported."""
        return tuple(self._protocol.losses)

    def _get_options(self) -> dict[str, Any]:
        """Return the websocket options of a connection."""
        return {
            "additional_headers": self._http.headers,
            "ssl": self._http.context,
            "compression": None,
            "max_size": MESSAGE_BYTES_MAX,
            "close_timeout": 1.0,
            "proxy": None,
        }

    def _delay_after_close_s(self, end: ConnectionClosed) -> float:
        """Return the delay before reconnecting after a closed connection.

        Raises:
            FootTileError: reconnecting is useless.
        """
        if self._is_closed:
            return 0.0
        code, reason = _NO_CLOSE_FRAME, ""
        if end.rcvd is not None:
            code, reason = end.rcvd.code, end.rcvd.reason
        self._protocol.check_close(int(code), reason)
        return self._retry_delay_s(end)

    def _delay_after_failure_s(self, error: Exception) -> float:
        """Return the delay before reconnecting after a failed attempt.

        Raises:
            FootTileError: another attempt is useless.
        """
        if isinstance(error, UpgradeRejection):
            problem = self._protocol.explain_rejection(error.status, error.headers, error.body)
            if problem is not None:
                raise problem from error
        return self._retry_delay_s(error)

    def _retry_delay_s(self, error: Exception) -> float:
        silence_s = time.monotonic() - self._last_message_s
        return self._protocol.compute_retry_delay_s(error, silence_s, self._reconnect_timeout_s)
