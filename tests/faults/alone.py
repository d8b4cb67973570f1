"""Plays a story of a node that has no server and records by itself."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from tests.faults.facts import Facts, journal_of
from tests.faults.machines import Machine, RoundError, wait_for
from tests.faults.product import NODE, run_command
from tests.faults.stage import Stage
from tests.faults.stories import Fault
from tests.waiting import PATIENCE_S

_FRAMES = 20
_RECOVERED = (0, 3)


class Alone(Stage):
    """A node with `--record`. What it took is known from its journal only, as it was at each kill:
    nobody sees the frames in between, so what is checked is that nothing written is lost, not that
    nothing taken is.
    """

    _known: frozenset[str] = frozenset()

    def begin(self) -> None:
        """Start it.

        Raises:
            RoundError: it does not record.
        """
        with self._timed("start"):
            self.node.start()
            self.wait_back()
        self.facts.started_s = time.monotonic()

    def end(self) -> list[Facts]:
        """End the node, which seals the session, and read what it has sealed.

        Raises:
            RoundError: it does not end, or there is no session.
        """
        if not self._stopped:
            with self._timed("stop"):
                self.facts.stopped_s = time.monotonic()
                code = self.node.terminate(30.0)
                self.note(f"the node ended with {code}")
        with self._timed("fetch"):
            self._verify(self.node.root)
            return list(self._sessions())

    def wait_back(self, boot_before: str | None = None) -> None:
        """Until frames of a stream are in its journal, and of another stream than before.

        Raises:
            RoundError: they are not, or it has ended.
        """

        def back() -> bool:
            if not self.node.is_alive:
                raise RoundError(f"the node has ended: {self.node.said.read_text()[-2000:]}")
            # A power cut touches old folders, too: what counts is a name that was not there.
            for stream_id in self._stream_ids() - self._known:
                columns = journal_of(self.node.root, stream_id).get(stream_id)
                if columns is not None and len(columns["seq"]) >= _FRAMES:
                    return True
            return False

        wait_for("the node journals", back, PATIENCE_S)
        self._known = self._stream_ids()

    def _set_up(self, small: Mapping[str, Path | None]) -> None:
        self._set_up_node(None, None, small.get("node"))

    def _stream_ids(self) -> frozenset[str]:
        folder = self.node.root / "journal" / NODE
        return frozenset(path.name for path in folder.glob("*") if path.is_dir())

    def _stream_id(self) -> str | None:
        folders = [path for path in (self.node.root / "journal" / NODE).glob("*") if path.is_dir()]
        with suppress(OSError):
            return max(folders, key=lambda path: path.stat().st_ctime_ns).name if folders else None
        return None

    def _machines(self) -> tuple[Machine, ...]:
        return (self.node,)

    def _sessions(self) -> Iterator[Facts]:
        """Most often one; if its acquisition dies, the node seals it, and begins another."""
        self.facts.look_into_journal()
        folders = sorted((self.node.root / "sessions").iterdir())
        sessions = [json.loads((folder / "session.json").read_text()) for folder in folders]
        if not sessions:
            raise RoundError("the node has no session")
        named = [{part["stream_id"] for part in session["parts"]} for session in sessions]
        for folder, session, streams in zip(folders, sessions, named, strict=True):
            path = folder / "frames.parquet"
            yield replace(
                self.facts,
                session=session,
                ledger=session["ledger"] or {},
                file=path.read_bytes() if path.exists() else None,
                elsewhere=frozenset(set().union(*named) - streams),
                lossy_elsewhere=any((other["ledger"] or {}).get("lossy") for other in sessions),
            )

    def _kill_and_recover(self, fault: Fault) -> None:
        self._recover("killed", lambda: None)

    def _power_and_recover(self, fault: Fault) -> None:
        self._recover("power", lambda: self._cut(self.node))

    def _recover(self, how: str, then: Callable[[], Any]) -> None:
        self._end_node(how, self.node.kill)
        then()
        self.facts.stopped_s = time.monotonic()
        self._stopped = True
        recovered = run_command("recover", self.node.root, **self.node.disk.environment())
        if recovered.returncode not in _RECOVERED:
            raise RoundError(f"recover ended with {recovered.returncode}: {recovered.stderr}")
