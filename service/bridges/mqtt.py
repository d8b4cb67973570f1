"""MQTT: summaries, states of nodes and events of sessions as JSON on a broker.

Under `foottile/`: `NODE/summary` is a message `frame` of the live page, `NODE/state` is retained,
`NODE/event` is a marker or a change of a session. `bridge/ID` is retained, too: `online`, or by the
last will `offline`, after which no state with this `bridge` holds. The id is the client's, and
stays: after a change of network the broker ends the connection before; a late will is corrected.

Of a slow broker's summaries only the newest of each node waits, and of its events the newest
thousand. While there is no broker, summaries are dropped.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import re
import uuid
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any
from urllib.parse import unquote, urlsplit

import aiomqtt

from devices.errors import UsageError
from foottile.connection import make_context
from foottile.environment import read_variable
from service.bridges.follower import Event, LiveClock, Outlet, Reporter
from service.protocol.codec import run_until_first_ends

USER_VARIABLE, PASSWORD_VARIABLE = "FOOTTILE_MQTT_USER", "FOOTTILE_MQTT_PASSWORD"
_EVENTS_MAX = 1000
_FAREWELL_S = 5.0
"""Timeout of the last message: without it `online` would stay, as a regular end sends no will."""
_RETRY_S = 1.0
_AT_MOST_ONCE, _AT_LEAST_ONCE = 0, 1
_STATE_FIELDS = (
    *("stream_id", "scene", "schedule", "nominal_rate_hz"),
    *("calibration_problem", "tare_problem", "storage_problem"),
)


class MqttOutlet(Outlet):
    """Client of a broker.

    Args:
        broker: `mqtt://[USER:PASSWORD@]HOST[:PORT][/TOPIC]`, `mqtts://` with TLS. User and password
            may be in variables instead.
        rate_hz: rate of summaries, 1 to 60.
        reporter: reporter of problems.
        source: server and nodes that the bridge follows: each has an id of its own.
        ca: file or folder of further CA certificates.

    Raises:
        UsageError: the address is invalid.
    """

    def __init__(
        self,
        broker: str,
        rate_hz: float,
        reporter: Reporter,
        source: str,
        ca: str | os.PathLike[str] | None = None,
    ) -> None:
        self.rate_hz, self._reporter = rate_hz, reporter
        try:
            parts = urlsplit(broker)
            port = parts.port
        except ValueError:
            parts, port = urlsplit(""), None
        has_tls = parts.scheme == "mqtts"
        if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname:
            raise UsageError(
                "the broker's address is invalid", expected="mqtt://HOST:PORT, or mqtts:// with TLS"
            )
        self._topic = unquote(parts.path).strip("/") or "foottile"
        if re.search("[+#\0]|^\\$", self._topic):
            raise UsageError(
                f"the topic {self._topic!r} cannot be published to",
                expected="the address's path as topic: without + and #, and no $ at its begin",
            )
        self.id = make_bridge_id(source, self._topic)
        self._subject = f"broker {parts.hostname}"
        user, password = parts.username, parts.password
        self._options: dict[str, Any] = {
            "identifier": self.id,
            "hostname": parts.hostname,
            "port": port or (8883 if has_tls else 1883),
            "username": unquote(user) if user else read_variable(USER_VARIABLE),
            "password": unquote(password) if password else read_variable(PASSWORD_VARIABLE),
            "tls_context": make_context(ca) if has_tls else None,
            "will": aiomqtt.Will(*self._make_bridge_message("offline")),
        }
        self._has_pending = asyncio.Event()
        self._is_connected = False
        self._events: deque[tuple[str, str]] = deque(maxlen=_EVENTS_MAX)
        self._states: dict[str, str] = {}
        self._unsent_states: set[str] = set()
        self._summaries: dict[str, str] = {}

    def write_event(self, event: Event, server_clock: LiveClock) -> None:
        """Queue an event."""
        topic = self._make_topic(event.node, "event")
        self._events.append((topic, json.dumps(asdict(event))))
        self._has_pending.set()

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Queue a summary in place of an unsent one."""
        topic = self._make_topic(summary["node"], "summary")
        if self._is_connected:
            problem = "too slow: summaries are dropped" if topic in self._summaries else None
            self._reporter.report(f"{self._subject}, {topic}", problem)
            self._summaries[topic] = json.dumps(summary)
            self._has_pending.set()

    def write_node(self, node: str, view: Mapping[str, Any] | None) -> None:
        """Queue a state that has changed."""
        state: dict[str, Any] = {"node": node, "state": "unknown", "bridge": self.id}
        if view is not None:
            state["state"] = "online" if view["connected"] else "offline"
            state |= {name: view[name] for name in _STATE_FIELDS}
            state["tiles"] = [tile["serial"] for tile in view["tiles"]]
        topic, text = self._make_topic(node, "state"), json.dumps(state)
        if self._states.get(topic) != text:
            self._states[topic] = text
            self._unsent_states.add(topic)
            self._has_pending.set()

    async def run(self) -> None:
        """Publish until cancelled; connect again when the broker is gone."""
        while True:
            try:
                async with aiomqtt.Client(**self._options) as client:
                    self._reporter.report(self._subject, None)
                    self._unsent_states |= self._states.keys()
                    self._is_connected = True
                    try:
                        await run_until_first_ends(
                            self._publish(client), self._correct_late_wills(client)
                        )
                    except asyncio.CancelledError:  # a regular end sends no last will
                        await client.publish(
                            *self._make_bridge_message("offline"), timeout=_FAREWELL_S
                        )
                        raise
            except aiomqtt.MqttError as error:
                if (task := asyncio.current_task()) is not None and task.cancelling():
                    raise asyncio.CancelledError from error  # the farewell has failed
                self._reporter.report(self._subject, f"no connection: {error}")
            self._is_connected = False
            self._summaries.clear()
            await asyncio.sleep(_RETRY_S)

    async def _correct_late_wills(self, client: aiomqtt.Client) -> None:
        """Publish `online` whenever the bridge's topic says otherwise, until disconnected."""
        topic, online, *_ = self._make_bridge_message("online")
        await client.subscribe(topic, _AT_LEAST_ONCE)
        async for message in client.messages:  # raises an error once it is disconnected
            if message.payload != online.encode():
                await client.publish(*self._make_bridge_message("online"))

    async def _publish(self, client: aiomqtt.Client) -> None:
        await client.publish(*self._make_bridge_message("online"))
        while True:
            while self._unsent_states:
                topic = self._unsent_states.pop()  # before: it may change meanwhile
                await client.publish(topic, self._states[topic], _AT_LEAST_ONCE, retain=True)
            while self._events:
                event = self._events[0]
                await client.publish(*event, _AT_LEAST_ONCE)
                if self._events[0] is event:  # it was not dropped meanwhile
                    self._events.popleft()
            for topic in tuple(self._summaries):
                await client.publish(topic, self._summaries.pop(topic), _AT_MOST_ONCE)
            self._has_pending.clear()
            if not (self._unsent_states or self._events or self._summaries):
                await self._has_pending.wait()

    def _make_bridge_message(self, state: str) -> tuple[str, str, int, bool]:
        return f"{self._topic}/bridge/{self.id}", state, _AT_LEAST_ONCE, True

    def _make_topic(self, node: str, kind: str) -> str:
        return f"{self._topic}/{re.sub('[+#/$]', '_', node)}/{kind}"


def make_bridge_id(source: str, topic: str) -> str:
    """Return the id of a bridge: the same at each start, another one for each machine and source.

    It has at most the 23 characters that every broker accepts.
    """
    content = f"{uuid.getnode()} {source} {topic}"
    return f"foottile-{hashlib.sha256(content.encode()).hexdigest()[:12]}"
