"""A server, a node, the link between them, and what is done with them: start, record, end, look."""

# ruff: noqa: S311  # seeded on purpose: a round can be run again

from __future__ import annotations

import json
import random
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Self

import httpx

from tests.faults.disk import SmallDisk, small_disk
from tests.faults.facts import End, Facts
from tests.faults.link_witness import Witness
from tests.faults.machines import Machine, NodeMachine, RoundError, ServerMachine, wait_for
from tests.faults.product import NODE, run_command
from tests.faults.proxy import Proxy
from tests.faults.stories import SMALL_DISK_BYTES, Story
from tests.waiting import PATIENCE_S

RATE_HZ = 200


def scene_file(folder: Path, tiles: int) -> Path:
    """A scene that starts fast: nothing is pressed on the bench, and nothing is measured first."""
    lines = [
        'name = "faults"\nmodels = ["unwrap", "static"]\ncalibration = "none"',
        f"rate_hz = {RATE_HZ}",
        '[array]\nconversion_ms = 1.6\nwait_ms = 1.7\nschedule = "simultaneous"',
        *(
            f'[[tile]]\nserial = "T{i + 1:02}"\nmux = 0x70\nchannel = {i}\n'
            f"x_m = {0.014 * i:.3f}\ny_m = 0\nz_m = -0.15"
            for i in range(tiles)
        ),
        '[ground]\nkind = "none"\n',
    ]
    path = folder / "scene.toml"
    path.write_text("\n".join(lines))
    return path


class Players:
    """A server, a node and the link between them; use as a context manager.

    Args:
        story: what to play.
        folder: for everything; there is nothing in it yet.
    """

    def __init__(self, story: Story, folder: Path) -> None:
        self.story = story
        self.log: list[str] = []
        """What was done, for whoever looks into a round that failed."""
        self.times: dict[str, float] = {}
        """How long each step took, in seconds."""
        self._rng = random.Random(story.seed + 1)
        self._slow_s = self._longest_wait_s = 0.0
        """How long an fsync of the node takes now, and the longest wait of its stream's frames,
        beyond the usual."""
        self._folder = folder
        self._stack = ExitStack()
        self._begin_s = time.monotonic()
        self.session_id = ""
        self._stopped = False
        self.witness = Witness()

    def __enter__(self) -> Self:
        small: SmallDisk | None = None
        if self.story.small_disk_of:
            small = self._stack.enter_context(small_disk(self._folder / "small", SMALL_DISK_BYTES))
        self._small = small
        folder = None if small is None else small.folder
        self._set_up({self.story.small_disk_of: folder})
        return self

    def _set_up(self, small: Mapping[str, Path | None]) -> None:
        """Make the machines; which of them has a small disk is given."""
        self.server = ServerMachine(self._folder / "server", small.get("server"))
        self._stack.callback(self.server.close)
        self.proxy = self._stack.enter_context(
            Proxy(self.server.port, seed=self.story.seed, tap=self.witness.tap)
        )
        self._set_up_node(self.proxy.port, self.server.root, small.get("node"))

    def _set_up_node(self, port: int | None, sealed_root: Path | None, small: Path | None) -> None:
        scene = scene_file(self._folder, self.story.tiles)
        self.node = NodeMachine(self._folder / "node", scene, port, small)
        self._stack.callback(self.node.kill)
        self.facts = Facts(
            self.story, self.witness, sealed_root or self.node.root, self.node.root, RATE_HZ
        )

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def wait_back(self, boot_before: str | None = None) -> None:
        """Until the node sends to the server, and, if asked for, another stream than before.

        Raises:
            RoundError: it does not, or has ended.
        """

        def back() -> bool:
            if not self.node.is_alive:
                raise RoundError(f"the node has ended: {self.node.said.read_text()[-2000:]}")
            node = self.server.node()
            return (
                node is not None
                and node["connected"]
                and node["last_seq"] is not None
                and node["stream_id"] != boot_before
            )

        wait_for("the node sends", back, PATIENCE_S)

    def end_node_when_it_dies(self, how: str, rng: random.Random) -> None:
        """The node will be killed at a call that was chosen; then it is started again.

        Args:
            how: `killed`, or `power`: then its disk is left as a power cut leaves it.
            rng: for that.

        Raises:
            RoundError: it is not killed, or does not come back.
        """

        def dies() -> None:
            wait_for("the node is killed", lambda: not self.node.is_alive, PATIENCE_S)
            self.node.kill()

        stream_id = self._end_node(how, dies)
        if how == "power":
            self.note(f"power of the node: {self.node.cut_power(rng)}")
        self._start_again(stream_id, self.node)

    def _start_session(self) -> None:
        def begun() -> dict[str, Any] | None:
            with suppress(RoundError):
                answer = self.server.post(
                    "/sessions", node=NODE, name="round", pre_roll_s=self.story.pre_roll_s
                )
                return dict(answer)
            return None

        session = wait_for("the session begins", begun, PATIENCE_S)
        assert session is not None
        self.session_id = session["id"]
        self.facts.started_s = time.monotonic()
        self.note(f"session {self.session_id} from {session['parts']}")

    def stop(self) -> None:
        """Stop the session, now.

        Raises:
            RoundError: it is refused.
            httpx.HTTPError: the server dies of it.
        """
        self._before_stop()
        self.server.post(f"/sessions/{self.session_id}/stop")

    def _before_stop(self) -> None:
        node = self.server.node() or {}
        clock = node.get("clock")
        if clock is not None:
            self.facts.stop_sigma_s = clock["uncertainty_ns"] * 1e-9
        elif node.get("connected"):  # else it is measured before the session ends
            self.facts.stop_sigma_s = None
        self.facts.stopped_s = time.monotonic()
        self._stopped = True

    def _wait_sealed(self) -> None:
        def sealed() -> bool:
            session = self.facts.session = self.server.get(f"/sessions/{self.session_id}")
            return bool(session["state"] == "sealed")

        with suppress(RoundError):  # what it is instead is for the checks
            wait_for("sealed", sealed, PATIENCE_S)

    def _fetch(self) -> None:
        facts = self.facts
        facts.session = self.server.get(f"/sessions/{self.session_id}")
        facts.ledger = self.server.get(f"/sessions/{self.session_id}/ledger")
        answer = self.server.download(f"/sessions/{self.session_id}/data")
        facts.file = answer.content if answer.status_code == httpx.codes.OK else None
        facts.look_into_journal()
        self.node.kill()
        self.server.terminate()
        self._verify(self.server.root)

    def _verify(self, root: Path) -> None:
        verified = run_command("verify", root, "--json")
        self.facts.verify_code = verified.returncode
        self.facts.verify_said = verified.stdout + verified.stderr

    def _machines(self) -> tuple[Machine, ...]:
        return self.node, self.server

    def _stream_id(self) -> str | None:
        """The newest stream that was announced."""
        return list(self.witness.infos)[-1] if self.witness.infos else None

    def _end_node(
        self, how: str, end: Callable[[], None], *, only: str | None = None
    ) -> str | None:
        """End the node and note what its streams had then; the newest stream's name."""
        newest = self._stream_id()
        at_s = time.monotonic()
        end()
        held = self.facts.look_into_journal()
        known = [*self.witness.infos, *(stream_id for stream_id in held)]
        for stream_id in known:
            if stream_id not in self.facts.ends and only in (None, stream_id):
                columns = held.get(stream_id)
                last_seq = None if columns is None else int(columns["seq"][-1])
                self.facts.ends[stream_id] = End(
                    how, last_seq, at_s, self._slow_s, self._longest_wait_s
                )
        self._longest_wait_s = self._slow_s
        return newest

    def _cut(self, machine: Machine) -> None:
        self.note(f"power of the {machine.name}: {machine.cut_power(self._rng)}")

    def _start_again(self, stream_id: str | None, *machines: Machine) -> None:
        for machine in machines:
            machine.slow.set_s(0.0)
            machine.start()
        if any(isinstance(machine, ServerMachine) for machine in machines):
            self.server.wait_ready()
        self.wait_back(stream_id)

    @contextmanager
    def _timed(self, step: str) -> Iterator[None]:
        begin_s = time.monotonic()
        try:
            yield
        finally:
            self.times[step] = self.times.get(step, 0.0) + time.monotonic() - begin_s

    def note(self, text: str) -> None:
        """For the log."""
        self.log.append(f"{time.monotonic() - self._begin_s:7.3f} {text}")

    def write_down(self) -> None:
        """Keep what was done and found beside the round's files."""
        lines = [*self.log, json.dumps(self.facts.session), json.dumps(self.facts.ledger)]
        (self._folder / "round.txt").write_text("\n".join(lines) + "\n")
