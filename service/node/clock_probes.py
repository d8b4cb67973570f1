"""The offset between a node's clock and the server's, measured over a connection.

Of several probes the one with the shortest round trip counts: half of it bounds the error, however
lopsided the ways there and back were.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress

from websockets.asyncio.client import ClientConnection

from service.link import PROBES, SILENCE_S, ClockRow, Probe, say

PROBE_EVERY_S = 10.0
"""Two crystals of 50 ppm part by 1 ms at most in this time."""


class ClockProbes:
    """Probes of one connection.

    Args:
        socket: the connection.
        utc_offset_ns: `t_ns` minus `t_mono_ns` of the stream that is being taken.
    """

    def __init__(self, socket: ClientConnection, utc_offset_ns: int) -> None:
        self._socket = socket
        self._utc_offset_ns = utc_offset_ns
        self._answers: asyncio.Queue[Probe] = asyncio.Queue(PROBES)

    def answered(self, probe: Probe) -> None:
        """The server has answered a probe."""
        with suppress(asyncio.QueueFull):
            self._answers.put_nowait(probe)

    async def run(self) -> None:
        """Measure and tell the server, again and again; what was not measured is not sent."""
        number = 0
        while True:
            best: ClockRow | None = None
            for _ in range(PROBES):
                number += 1
                sent_ns = time.monotonic_ns()
                await self._socket.send(say(Probe(id=number)))
                answer = await self._answer_to(number)
                came_ns = time.monotonic_ns()
                if answer is None or answer.server_t_ns is None:
                    continue
                middle_ns = (sent_ns + came_ns) // 2
                half_ns = (came_ns - sent_ns + 1) // 2
                if best is None or half_ns < best.uncertainty_ns:
                    best = ClockRow(
                        t_mono_ns=middle_ns,
                        server_minus_node_ns=answer.server_t_ns - middle_ns - self._utc_offset_ns,
                        uncertainty_ns=half_ns,
                    )
            if best is not None:
                await self._socket.send(say(best))
            await asyncio.sleep(PROBE_EVERY_S)

    async def _answer_to(self, number: int) -> Probe | None:
        with suppress(TimeoutError):
            async with asyncio.timeout(SILENCE_S):
                while True:
                    answer = await self._answers.get()
                    if answer.id == number:  # not a late one
                        return answer
        return None
