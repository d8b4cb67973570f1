"""The MQTT bridge with a real broker and another client of it."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from devices.errors import UsageError
from service.bridges import mqtt
from service.bridges.follower import Event, LiveClock, Reporter
from service.bridges.mqtt import MqttOutlet
from tests.service.bridges.broker import RunningBroker
from tests.service.fake_node import FakeNode, Play
from tests.service.process import Start
from tests.service.running import Running, receive_live
from tests.service.strangers import listening
from tests.waiting import PATIENCE_S, in_a_loop, until

pytestmark = pytest.mark.process

BRIDGE = "foottile/bridge/*"
SOURCE = "http://here []"


@pytest.fixture
def broker() -> Iterator[RunningBroker]:
    broker = RunningBroker()
    yield broker
    broker.stop()


def test_summaries_states_and_events_of_a_node_are_on_the_broker(
    running: Running, tared: FakeNode, foottile: Start, broker: RunningBroker
) -> None:
    foottile("bridge", "mqtt", broker.url, "--rate", 5, "--server", running.url)
    assert broker.receive(BRIDGE).content == "online"
    state = broker.receive("foottile/bench/state").content
    assert (state["state"], state["tiles"]) == ("online", ["T01", "T02"])
    with running.socket("/api/v1/live?rate_hz=5") as page, Play(tared, [20.0, 160.0]):
        summary = broker.receive("foottile/bench/summary", lambda each: each["seq"] > 75).content
        shown = receive_live(page, lambda each: each["type"] == "frame" and each["seq"] > 75)
        assert summary.keys() == shown.keys()
        assert summary["grf_n"] is None  # a tile is beyond its calibrated range
        assert summary["saturated"] == [False, True]
        assert summary["force_n"][0] == pytest.approx(20.0, rel=0.01)
        recording = tared.record(name="mud")
        started = broker.receive("foottile/bench/event").content
        assert (started["kind"], started["text"]) == ("recording_started", "mud")
        marker = running.http.post(f"{recording.url}/markers", json={"label": "a stone"}).json()
        assert broker.receive("foottile/bench/event").content == {
            "kind": "marker",
            "node": "bench",
            "session_id": recording.id,
            "text": "a stone",
            "t_ns": marker["t_ns"],
        }
        recording.stop()
        assert broker.receive("foottile/bench/event").content["kind"] == "recording_stopped"
    tared.leave()
    broker.receive("foottile/bench/state", lambda each: each["state"] == "offline")


# amqtt drops what it has acknowledged and not yet passed on when a client disconnects.
@pytest.mark.soak
def test_a_bridge_that_is_ended_is_offline(
    running: Running, tared: FakeNode, foottile: Start, broker: RunningBroker
) -> None:
    bridge = foottile("bridge", "mqtt", broker.url, "--server", running.url)
    assert broker.receive(BRIDGE).content == "online"
    broker.receive("foottile/bench/state")
    time.sleep(1.0)  # until no message waits for its acknowledgement
    bridge.process.send_signal(signal.SIGINT)
    assert broker.receive(BRIDGE).content == "offline"
    assert bridge.ended() == 0


@pytest.mark.slow
def test_a_bridge_that_is_killed_is_offline_by_its_last_will(
    running: Running, tared: FakeNode, foottile: Start, broker: RunningBroker
) -> None:
    bridge = foottile("bridge", "mqtt", broker.url, "--server", running.url)
    assert broker.receive(BRIDGE).content == "online"
    bridge.process.kill()
    assert broker.receive(BRIDGE).content == "offline"


def test_a_late_will_of_an_earlier_connection_is_corrected(
    running: Running, tared: FakeNode, foottile: Start, broker: RunningBroker
) -> None:
    foottile("bridge", "mqtt", broker.url, "--server", running.url)
    state = broker.receive("foottile/bench/state").content
    status = f"foottile/bridge/{state['bridge']}"
    for _ in range(2):
        broker.publish_retained(status, "offline")
        assert broker.receive(status, lambda each: each == "offline")
        assert broker.receive(status).content == "online"


def test_a_bridge_keeps_its_id_and_shares_it_with_no_other() -> None:
    ids = {
        MqttOutlet(f"mqtt://host/{topic}", 1.0, Reporter(print), source).id
        for topic in ("", "lab")
        for source in (SOURCE, "http://there []", "http://here ['left']")
        for _ in range(2)
    }
    assert len(ids) == 6
    assert max(map(len, ids)) <= 23
    first, second = (
        MqttOutlet("mqtt://host", 1.0, Reporter(print), source)._options["will"]
        for source in (SOURCE, "http://there []")
    )
    assert first.topic != second.topic, "one speaks for the other"


@pytest.mark.parametrize("topic", ["a/+", "%23", "$SYS", "a%00"])
def test_a_topic_that_no_broker_takes_is_refused(topic: str) -> None:
    with pytest.raises(UsageError, match="topic"):
        make_outlet(f"mqtt://host/{topic}", [])


@pytest.mark.slow
def test_a_broker_that_comes_back_gets_states_and_the_events_of_meanwhile(
    running: Running, tared: FakeNode, foottile: Start, broker: RunningBroker
) -> None:
    bridge = foottile("bridge", "mqtt", broker.url, "--server", running.url)
    broker.receive("foottile/bench/state")
    broker.stop()
    bridge.said("no connection")
    tared.record(name="mud")
    broker.start()
    events = "foottile/bench/event"
    assert broker.receive(events).content["text"] == "mud"
    bridge.said("works again")
    assert len([line for line in bridge.err if "no connection" in line]) == 1


def make_outlet(url: str, said: list[str]) -> MqttOutlet:
    return MqttOutlet(url, 1.0, Reporter(said.append), SOURCE)


def test_what_waits_for_a_broker_is_bounded() -> None:
    outlet = make_outlet("mqtt://127.0.0.1:1", [])
    for number in range(5000):
        outlet.write_event(Event("marker", "left", "s", str(number), number), LiveClock())
        outlet.write_summary({"node": "left", "seq": number})
    assert [json.loads(text)["t_ns"] for _, text in outlet._events] == list(range(4000, 5000))
    assert not outlet._summaries  # old news is of no use to anybody


def test_of_a_slow_broker_only_the_newest_summary_waits_and_that_is_said_once() -> None:
    said: list[str] = []
    outlet = make_outlet("mqtt://127.0.0.1:1", said)
    outlet._is_connected = True
    for number in range(9):
        outlet.write_summary({"node": "left", "seq": number})
    assert json.loads(outlet._summaries["foottile/left/summary"])["seq"] == 8
    assert len(said) == 1


class SlowClient:
    """A client of a broker that acknowledges one message, and others when it is told."""

    def __init__(self) -> None:
        self.published: list[tuple[str, str]] = []
        self.left = asyncio.Semaphore(1)

    async def publish(self, topic: str, text: str, *_: object, **__: object) -> None:
        self.published.append((topic, text))
        await self.left.acquire()


@in_a_loop
async def test_what_changes_while_the_broker_is_slow_is_published_after_it() -> None:
    outlet, client = make_outlet("mqtt://127.0.0.1:1", []), SlowClient()
    outlet.write_node("left", None)
    publishing = asyncio.create_task(outlet._publish(client))  # type: ignore[arg-type]  # a SlowClient
    while len(client.published) < 2:
        await asyncio.sleep(0)
    outlet._states.clear()
    outlet.write_node("left", None)  # as after a change
    for _ in range(9):
        client.left.release()
    while outlet._has_pending.is_set():
        await asyncio.sleep(0)
    states = [text for topic, text in client.published if topic.endswith("state")]
    assert len(states) == 2
    publishing.cancel()


@in_a_loop
async def test_an_event_waits_for_the_next_connection_until_it_is_acknowledged() -> None:
    outlet, client = make_outlet("mqtt://127.0.0.1:1", []), SlowClient()
    outlet.write_event(Event("marker", "left", "s", "stone", 1), LiveClock())
    publishing = asyncio.create_task(outlet._publish(client))  # type: ignore[arg-type]  # a SlowClient
    while len(client.published) < 2:
        await asyncio.sleep(0)
    publishing.cancel()
    await asyncio.gather(publishing, return_exceptions=True)
    assert len(outlet._events) == 1


@in_a_loop
async def test_it_ends_although_the_broker_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    assert mqtt._FAREWELL_S <= 5.0
    monkeypatch.setattr(mqtt, "_FAREWELL_S", 0.5)

    def accept_and_hang(connection: socket.socket, ended: threading.Event) -> None:
        connection.recv(1 << 16)
        connection.sendall(b"\x20\x02\x00\x00")
        ended.wait(PATIENCE_S)

    with listening(accept_and_hang) as port:
        outlet = make_outlet(f"mqtt://127.0.0.1:{port}", [])
        running = asyncio.create_task(outlet.run())
        while not outlet._is_connected:
            await asyncio.sleep(0.01)
        running.cancel()
        done, _ = await asyncio.wait([running], timeout=PATIENCE_S)
        running.cancel()  # of one that goes on
    assert done
    assert running.cancelled()


def test_address_user_and_password_come_from_the_url_or_the_environment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options = make_outlet("mqtts://me:a%40b@host/lab/feet", [])._options
    assert (options["hostname"], options["port"]) == ("host", 8883)
    assert (options["username"], options["password"]) == ("me", "a@b")
    assert options["tls_context"].check_hostname
    assert options["will"].topic == f"lab/feet/bridge/{options['identifier']}"
    monkeypatch.setenv("FOOTTILE_MQTT_USER", "you")
    monkeypatch.setenv("FOOTTILE_MQTT_PASSWORD", "secret")
    options = make_outlet("mqtt://host", [])._options
    assert (options["port"], options["tls_context"]) == (1883, None)
    assert (options["username"], options["password"]) == ("you", "secret")


@pytest.mark.parametrize("url", ["host", "http://host", "mqtt://", "mqtt://host:x", "mqtt://[::"])
def test_another_address_is_refused(url: str) -> None:
    with pytest.raises(UsageError, match="broker"):
        make_outlet(url, [])


def test_a_name_of_a_node_is_one_level_of_a_topic() -> None:
    outlet = make_outlet("mqtt://host", [])
    outlet.write_node("a/b+#", None)
    assert list(outlet._states) == ["foottile/a_b__/state"]
    until(outlet._has_pending.is_set)
