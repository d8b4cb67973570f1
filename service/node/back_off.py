"""How long a node waits before it dials a server once more, and what it says of a failure."""

from __future__ import annotations

import random

from websockets.exceptions import ConnectionClosed, InvalidStatus

from service.link import Close

BACK_OFF_S = (0.1, 0.5)
"""Between attempts at a server that cannot be reached: the picture is back within a second."""
REFUSED_BACK_OFF_S = (0.2, 5.0)
"""Between attempts at one that answered, and did not want us."""
_UNAUTHORISED = 401


class BackOff:
    """How long to wait before the next attempt."""

    def __init__(self) -> None:
        self._bounds = BACK_OFF_S
        self._wait_s = 0.0

    def succeeded(self) -> None:
        """A server has welcomed the node."""
        self._bounds, self._wait_s = BACK_OFF_S, 0.0

    def failed(self, error: Exception) -> None:
        """An attempt, or a connection, has ended for this reason."""
        bounds = REFUSED_BACK_OFF_S if _is_refusal(error) else BACK_OFF_S
        if bounds != self._bounds:
            self._bounds, self._wait_s = bounds, bounds[0]

    def next_s(self) -> float:
        """How long to wait now: each time longer, and never two nodes at the same instant."""
        least, most = self._bounds
        self._wait_s = min(max(2.0 * self._wait_s, least), most)
        return self._wait_s * random.uniform(0.5, 1.0)  # noqa: S311  # no secret


def _is_refusal(error: BaseException) -> bool:
    if isinstance(error, ConnectionClosed):
        # One that is going down will be back, and what was damaged on its way is sent once more.
        soon = (Close.RESTART, Close.MALFORMED)
        return error.rcvd is not None and error.rcvd.code not in soon
    return isinstance(error, InvalidStatus)


def reason_of(error: Exception) -> str:
    """Why there is no connection, in words."""
    if isinstance(error, ConnectionClosed) and error.rcvd is not None:
        return error.rcvd.reason or f"closed with code {error.rcvd.code}"
    if isinstance(error, InvalidStatus) and error.response.status_code == _UNAUTHORISED:
        return "the server wants its token: set FOOTTILE_TOKEN to the one `foottile serve` prints"
    if isinstance(error, InvalidStatus):
        said = error.response.body.decode(errors="replace")[:300] if error.response.body else ""
        return f"HTTP {error.response.status_code} {said}".strip()
    return str(error) or type(error).__name__
