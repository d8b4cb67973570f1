"""Programs that take every frame live, while the server is killed and others stall beside them."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from functools import partial

import foottile
from tests.hostile.attack import Outcome, Play, attack
from tests.hostile.stage import Served
from tests.service.fake_node import FakeNode
from tests.waiting import until

_FRAMES = 2000
_STALLED = ("lossless", "drop_oldest", "latest")
_GROWN_MAX_MB = 100.0


class Program(threading.Thread):
    """Takes every frame from a number on, over as many connections as that takes."""

    def __init__(self, url: str, stream_id: str, from_seq: int) -> None:
        super().__init__(name="program")
        self.seqs: list[int] = []
        self.grf_n: dict[int, float | None] = {}
        self.problem: BaseException | None = None
        self._server = foottile.connect(url)
        self._live = self._server.live("bench", "grf_n", stream_id=stream_id, from_seq=from_seq)
        self.start()

    def run(self) -> None:
        try:
            for batch in self._live:
                seqs = [int(seq) for seq in batch["seq"].to_numpy()]
                self.seqs += seqs
                self.grf_n |= dict(zip(seqs, batch["grf_n"].to_pylist(), strict=True))
        except BaseException as error:
            self.problem = error

    def has_or_failed(self, seq: int) -> bool:
        return self.problem is not None or (bool(self.seqs) and self.seqs[-1] >= seq)

    def close(self) -> None:
        self._live.close()
        self.join()
        self._server.close()

    def wrong(self, first: int) -> str:
        """What must not be, in words; empty if nothing is."""
        if self.problem is not None:
            return repr(self.problem)
        if self._live.losses:
            return f"said to be lost: {self._live.losses}"
        if self.seqs != list(range(first, first + len(self.seqs))):
            return "frames are missing, or came twice"
        return ""


@attack("programs that take every frame, and the server is killed", tries=1, soak_tries=10)
def killed(play: Play) -> Outcome:
    """SIGKILL to the server in the middle of live streams, beside clients that read nothing.

    One program takes frames as they come, two ask for all that are old at once, and one of each
    policy connects and reads nothing. It fails if a program misses a frame, has one twice, or is
    told of a loss; if the two have not the same numbers; if the server grows by more than 100 MB,
    or speaks of a bug.
    """
    outcome = Outcome()
    served = Served(play.folder, outcome=outcome)
    with ExitStack() as stack:
        server = stack.enter_context(ExitStack())
        server.enter_context(served)
        node = FakeNode(served)
        stack.callback(node.close)
        node.connect()
        node.tared()
        first = node.seq
        taking = Program(served.url, node.stream_id, first)
        stack.callback(taking.close)
        for _ in range(play.tries):
            rss_mb = served.rss_mb
            stalled = ExitStack()
            for policy in _STALLED:
                path = f"/api/v1/live?format=arrow&policy={policy}&from_seq=0"
                stalled.enter_context(served.socket(path, small=True, max_queue=1))
            for _ in range(_FRAMES // 100):
                node.send(100, 20.0, alive=True)
            until(partial(taking.has_or_failed, node.seq - play.random.randrange(100, _FRAMES)))
            outcome.figures["the server grew by"] = f"{served.rss_mb - rss_mb:.1f} MB"
            if served.rss_mb - rss_mb > _GROWN_MAX_MB:
                outcome.failed(f"the server grew by {served.rss_mb - rss_mb:.0f} MB")
            served.process.process.kill()
            stalled.close()
            began_s = time.monotonic()
            server.close()
            server.enter_context(served)
            node.connect()
            rows = node.all_sent()
            for a, b in node.lacks[node.stream_id]:
                node.send_again(rows.slice_rows(a, node.seq if b is None else b + 1))
            node.send(50, 20.0, alive=True)
            old = [Program(served.url, node.stream_id, 0) for _ in range(2)]
            programs = (taking, *old)
            for each in programs:
                until(partial(each.has_or_failed, node.seq - 20))
            outcome.figures["until all had everything"] = f"{time.monotonic() - began_s:.1f} s"
            for each in old:
                each.close()
            wrong = [w for p in programs if (w := p.wrong(first if p is taking else 0))]
            both = old[0].grf_n.keys() & old[1].grf_n.keys()
            if any(old[0].grf_n[seq] != old[1].grf_n[seq] for seq in both):
                wrong.append("two that asked at once have other numbers")
            if wrong:
                outcome.failed("; ".join(wrong))
            else:
                outcome.saw("every frame came once, to each")
    return outcome
