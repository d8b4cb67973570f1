"""Whatever can be said on the two websockets, said to a server at work."""

from __future__ import annotations

import asyncio
import hashlib
import json
import subprocess
import sys
import time
import uuid
from abc import ABC, abstractmethod
from pathlib import Path
from random import Random
from typing import Any

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from devices.frames import ArrayInfo
from service.api.protocols import CLIENT_MESSAGE_BYTES_MAX
from service.protocol.codec import append_crc, strip_text_crc
from service.protocol.link import (
    INGEST_PATH,
    MESSAGE_BYTES_MAX,
    PROTOCOL,
    SUBPROTOCOL,
    Challenge,
    ClockProbe,
    ClockSample,
    EarlierStream,
    Hello,
    Identify,
    LossReport,
    NodeStatus,
    Proof,
    StreamSelect,
    make_proof,
)
from service.protocol.live import LIVE_PATH
from storage.wire import encode_as_messages
from tests.builders.arrays import PERIOD_NS, make_array
from tests.builders.calibrations import make_calibration, make_effects, newton_tile
from tests.builders.frames import make_frames, with_columns
from tests.builders.odd_values import ODD_VALUES
from tests.hostile.attack import Outcome, Play, attack
from tests.hostile.stage import Served, recording
from tests.hostile.wrong_messages import DEEP, checked_text, damaged, wrong_batch, wrong_text

_SIDE_BY_SIDE = 4
_GROWTH_MAX_MB = 20.0
_GAP_MAX_S = 1.0
_ANSWER_S = 10.0
_WARM_UP = 2000
"""Tries after which memory is measured first."""
_CODES = (1007, 1008, 1009, 4001, 4002, 4004, 4009, 4010, 4013)
"""With which whoever says nonsense may be let go."""


_UNLIMITED = tuple(
    word
    for name in ("", "-per-address", "-in-all")
    for word in (f"--max-messages-per-s{name}", 100_000)
)
"""Its connections come as quickly as they can: how many may is another attack."""


@attack("mutated and well-formed but wrong messages", tries=200, soak_tries=100_000)
def messages(play: Play) -> Outcome:
    """Messages to `/api/v1/ingest` and `/api/v1/live` of a server that records, with a screen.

    A try is one message: a right one in which one field or two are NaN, infinite, huge, empty,
    long, nested, of another type; an Arrow batch with another schema, compressed, with lengths that
    are not so, with time that runs back; or bytes damaged on their way. It fails if it is not
    answered, if the connection ends in another way than with a code for nonsense, or if after all
    the server has grown by 20 MB, the screen had a pause of a second, the recording beside it lost
    a frame, the log speaks of a bug, a name stays taken, the server does not start again on its
    folder, or `foottile verify` finds damage in it.
    """
    outcome = Outcome()
    with Served(play.folder, "serve", *_UNLIMITED, outcome=outcome) as served:
        with recording(served, outcome):
            asyncio.run(_attacked(play, served, outcome))
        _check_gap(outcome)
        for number in range(_SIDE_BY_SIDE):
            asyncio.run(_name_is_free(served, number, outcome))
    with Served(play.folder, outcome=outcome) as again:
        if not again.http.get("/nodes").json()["items"]:
            outcome.failures.append("after a restart the server knows no node")
    _check_files(play.folder / "data", outcome)
    return outcome


async def _attacked(play: Play, served: Served, outcome: Outcome) -> None:
    warm = min(_WARM_UP, play.tries // 3)
    await _side_by_side(play, served, outcome, warm)
    before_mb = served.rss_mb
    await _side_by_side(play, served, outcome, play.tries - warm)
    grown_mb = served.rss_mb - before_mb
    outcome.figures["the server's memory"] = f"{grown_mb:+.1f} MB"
    if grown_mb > _GROWTH_MAX_MB:
        outcome.failures.append(f"the server has grown by {grown_mb:.1f} MB")


async def _side_by_side(play: Play, served: Served, outcome: Outcome, tries: int) -> None:
    end = outcome.tries + tries
    await asyncio.gather(
        *(
            _hostile(served, Random(play.random.random()), number, outcome, end)  # noqa: S311  # drawn again from the seed, no secret
            for number in range(_SIDE_BY_SIDE)
        )
    )


async def _hostile(served: Served, random: Random, number: int, outcome: Outcome, end: int) -> None:
    """One foreign program: it says what it should not until all tries are made."""
    foreign: _Foreign | None = None
    while outcome.tries < end:
        if foreign is None:
            foreign = (
                _Node(served, random, number) if random.random() < 0.8 else _Viewer(served, random)
            )
        happened = await foreign.tried()
        if happened.startswith("!"):
            outcome.failed(f"{happened[1:]}; the log ends with {served.log[-3:]}")
        else:
            outcome.saw(happened)
        if happened != "taken":
            await foreign.close()
            foreign = None
    if foreign is not None:
        await foreign.close()


class _Foreign(ABC):
    """A connection that is used until it is hung up on."""

    path = ""
    most_bytes = MESSAGE_BYTES_MAX

    def __init__(self, served: Served, random: Random) -> None:
        self._url = served.url.replace("http", "ws")
        self._headers = served.shown
        self.random = random
        self.socket: ClientConnection | None = None

    async def tried(self) -> str:
        """Say something wrong; what came of it, in words, with "!" before if it may not be."""
        said: Any = None
        try:
            async with asyncio.timeout(_ANSWER_S):
                try:
                    if self.socket is None:
                        self.socket = await self.opened()
                    said = self.wrong()
                    await self.say(said)
                    await self.answered()
                except ConnectionClosed as closed:
                    code = closed.rcvd.code if closed.rcvd is not None else 1006
                    if code == 1006 and said is not None and len(said) > self.most_bytes:
                        code = 1009  # it did not wait until all of it was sent
                    if code in _CODES:
                        return f"let go with {code}"
                    return f"!hung up with {code} ({closed}) after {said!r:.300}"
        except TimeoutError:
            return f"!no answer for {_ANSWER_S:g} s after {said!r:.300}"
        except OSError as error:
            return f"!{error!r} after {said!r:.300}"
        return "taken"

    async def close(self) -> None:
        if self.socket is not None:
            await self.socket.close()

    async def connected(self, query: str = "") -> ClientConnection:
        return await connect(
            self._url + self.path + query,
            additional_headers=self._headers,
            subprotocols=[SUBPROTOCOL],  # type: ignore[list-item]  # a NewType of str
            compression=None,
            ping_interval=None,
            proxy=None,
            close_timeout=2.0,
        )

    @abstractmethod
    async def opened(self) -> ClientConnection:
        """A connection on which something can be said."""

    @abstractmethod
    def wrong(self) -> Any:
        """What it should not say."""

    @abstractmethod
    async def answered(self) -> None:
        """Return when the server has taken what was said before."""

    async def say(self, message: Any) -> None:
        assert self.socket is not None
        await self.socket.send(message)


class _Node(_Foreign):
    """Says hello, right or wrong, and then what it likes."""

    path = INGEST_PATH

    def __init__(self, served: Served, random: Random, number: int) -> None:
        super().__init__(served, random)
        self._name = f"hostile{number}"
        self._info = make_array(
            2,
            node=self._name,
            stream_id=uuid.UUID(int=random.getrandbits(128)).hex,
            utc_offset_ns=time.time_ns() - time.monotonic_ns(),
        )
        self._begins_wrong = random.random() < 0.7
        self._seq = 0
        self._t_mono_ns = time.monotonic_ns()

    async def opened(self) -> ClientConnection:
        self.socket = await self.connected()
        if self._begins_wrong and self.random.random() < 0.2:
            return self.socket  # what comes is wrong before anything was said
        await self.say(checked_text(_identify(self._name)))
        challenge = Challenge.model_validate_json(await self.heard("challenge"))
        if self._begins_wrong and self.random.random() < 0.2:
            return self.socket
        # A node of this name has this secret in every run.
        secret = hashlib.sha256(self._name.encode()).hexdigest()
        proof = Proof(secret=secret)
        if challenge.is_known:
            proof = Proof(proof=make_proof(secret, challenge, self._name))
        await self.say(checked_text(json.loads(proof.model_dump_json())))
        if not self._begins_wrong:
            await self.say(checked_text(json.loads(_hello(self._info).model_dump_json())))
            await self.heard("welcome")
            if self.random.random() < 0.3:
                await self._send_right()
        return self.socket

    def wrong(self) -> Any:
        random = self.random
        if self._begins_wrong:
            self._begins_wrong = False
            return self._wrong_hello()
        kind = random.randrange(10)
        if kind < 4:
            return wrong_batch(random, self._info, self._seq, self._t_mono_ns)
        right = json.loads(random.choice(self._said()).model_dump_json())
        if kind < 8:
            return wrong_text(random, right)
        text: str | bytes = checked_text(right)
        if random.random() < 0.5:
            text = wrong_batch(random, self._info, self._seq, self._t_mono_ns)
        return damaged(random, text)

    async def answered(self) -> None:
        await self.say(checked_text({"type": "probe", "id": 7}))
        await self.heard("probe")

    async def heard(self, kind: str) -> str:
        assert self.socket is not None
        while True:
            text = strip_text_crc(await self.socket.recv())
            if json.loads(text)["type"] == kind:
                return text

    def _wrong_hello(self) -> Any:
        random = self.random
        first = random.choice([_identify(self._name), {"type": "proof", "secret": "0" * 64}])
        right = json.loads(_hello(self._info).model_dump_json())
        right = random.choice([right, right, first])
        kind = random.randrange(20)
        if kind == 0:
            return damaged(random, checked_text(right))
        if kind == 1:
            return random.choice(["", "x" * (MESSAGE_BYTES_MAX + 1), DEEP, b"\0" * 1000])
        if kind == 2:
            return checked_text(right).replace('"scene"', f'"more":{DEEP},"scene"')
        if kind == 3:
            return checked_text(random.choice(ODD_VALUES[:-1]))
        return wrong_text(random, right)

    def _said(self) -> list[Any]:
        stream_id = self._info.stream_id
        return [
            StreamSelect(stream_id=stream_id),
            ClockProbe(id=3),
            ClockSample(t_mono_ns=time.monotonic_ns(), server_minus_node_ns=0, uncertainty_ns=9),
            LossReport(stream_id=stream_id, lost={"node_busy": ((0, 0), (5, 6))}),
            NodeStatus(missed_slots=3, warnings=("T01: silent",), counts={"T01": {"stale": 4}}),
            _hello(self._info),
        ]

    async def _send_right(self) -> None:
        frames = make_frames(10, 2, utc_offset_ns=self._info.utc_offset_ns)
        frames = with_columns(frames, t_mono_ns=frames.t_mono_ns + self._t_mono_ns)
        for message in encode_as_messages(frames, self._info):
            await self.say(append_crc(message.payload))
        self._seq, self._t_mono_ns = 10, self._t_mono_ns + 10 * PERIOD_NS


class _Viewer(_Foreign):
    """A screen that says more than `ping`."""

    path = LIVE_PATH
    most_bytes = CLIENT_MESSAGE_BYTES_MAX

    async def opened(self) -> ClientConnection:
        odd = ("", "", "", "?rate_hz=nan", "?rate_hz=1e999", "?node=%00", "?format=x", "?a=%ff%fe")
        return await self.connected(self.random.choice(odd))

    def wrong(self) -> Any:
        random, odd = self.random, self.random.choice(ODD_VALUES)
        return random.choice(
            [
                json.dumps({"type": "ping", "t_ms": odd}),
                json.dumps({"type": odd, "t_ms": 1}),
                json.dumps({"type": "ping", "t_ms": 1, "more": odd}),
                json.dumps(odd),
                DEEP,
                "x" * (MESSAGE_BYTES_MAX + 1),
                random.randbytes(random.randrange(1, 2000)),
                damaged(random, '{"type":"ping","t_ms":12.5}'),
            ]
        )

    async def answered(self) -> None:
        await self.say('{"type":"ping","t_ms":-7}')
        assert self.socket is not None
        while True:
            message = json.loads(await self.socket.recv())
            if message["type"] == "pong" and message["t_ms"] == -7:
                return


def _identify(name: str) -> dict[str, Any]:
    return Identify(protocol=PROTOCOL, node=name).model_dump()


def _hello(info: ArrayInfo) -> Hello:
    earlier = info.model_copy(update={"stream_id": info.stream_id[::-1]})
    return Hello(
        protocol=PROTOCOL,
        array_info=info,
        stored=((0, 99), (200, 299)),
        next_seq=300,
        t_mono_ns=time.monotonic_ns(),
        lost={"evicted": ((100, 199),)},
        scene={"name": "test", "tile": [{"x_m": 0.5, "on": True, "note": None}]},
        emulated=False,
        calibration=make_calibration(newton_tile("T01", effects=make_effects()), "T02"),
        calibration_problem=None,
        earlier=(EarlierStream(array_info=earlier, stored=((0, 9),), next_seq=10),),
    )


async def _name_is_free(served: Served, number: int, outcome: Outcome) -> None:
    node = _Node(served, Random(f"after/{number}"), number)  # noqa: S311  # drawn again from the seed, no secret
    node._begins_wrong = False
    try:
        async with asyncio.timeout(_ANSWER_S):
            await node.opened()
    except (ConnectionClosed, TimeoutError) as error:
        outcome.failures.append(f"the name hostile{number} stays taken: {error!r}")
    await node.close()


def _check_gap(outcome: Outcome) -> None:
    gap = outcome.figures.get("longest pause of a screen", "")
    if gap and float(gap.removesuffix(" s")) >= _GAP_MAX_S:
        outcome.failures.append(f"the screen beside had a pause of {gap}")


def _check_files(data: Path, outcome: Outcome) -> None:
    foottile = Path(sys.executable).parent / "foottile"
    done = subprocess.run([foottile, "verify", data], capture_output=True, text=True, timeout=120)
    if done.returncode not in (0, 3):  # 3: whole, and lossy or not yet sealed
        outcome.failures.append(f"verify: {done.stdout[-500:]} {done.stderr[-500:]}")
