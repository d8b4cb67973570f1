"""Broker in a process of its own: amqtt leaves sockets open and tasks unfinished as it ends.

Run as a program, it serves on loopback at the port of its first argument; 0: any. It prints
the port.
"""

from __future__ import annotations

import asyncio
import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from fnmatch import fnmatch
from typing import Any, NamedTuple

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion

from tests.waiting import PATIENCE_S, left_s


class Received(NamedTuple):
    """A message of the broker."""

    topic: str
    content: Any


class RunningBroker:
    """A broker on loopback, with a client that receives all topics."""

    def __init__(self) -> None:
        self.port = 0
        self.received: queue.Queue[Received] = queue.Queue()
        self.start()

    @property
    def url(self) -> str:
        return f"mqtt://127.0.0.1:{self.port}"

    def start(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.service.bridges.broker", str(self.port)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self._process.stdout is not None
        self.port = int(self._process.stdout.readline())
        subscribed = threading.Event()
        self._client = Client(CallbackAPIVersion.VERSION2)
        self._client.on_subscribe = lambda *_: subscribed.set()
        self._client.on_message = lambda _, __, message: self._take(message)
        self._client.connect("127.0.0.1", self.port)
        self._client.subscribe("#", qos=1)
        self._client.loop_start()
        assert subscribed.wait(PATIENCE_S)

    def stop(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()
        self._process.kill()
        self._process.communicate()

    def publish_retained(self, topic: str, text: str) -> None:
        """Publish for another client, as the broker does a last will."""
        self._client.publish(topic, text, qos=1, retain=True)

    def receive(self, topic: str, is_wanted: Callable[[Any], bool] = lambda _: True) -> Received:
        """The next message of a topic, or of a pattern of topics, that is wanted; others go."""
        end_s = time.monotonic() + PATIENCE_S
        while True:
            message = self.received.get(timeout=left_s(end_s))
            if fnmatch(message.topic, topic) and is_wanted(message.content):
                return message

    def _take(self, message: MQTTMessage) -> None:
        text = message.payload.decode()
        content = json.loads(text) if text.startswith("{") else text
        self.received.put(Received(message.topic, content))


async def _serve(port: int) -> None:
    from amqtt.broker import Broker

    listener = {"type": "tcp", "bind": f"127.0.0.1:{port}"}
    plugins = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
    broker = Broker({"listeners": {"default": listener}, "plugins": plugins})
    await broker.start()
    (server,) = (each.instance for each in broker._servers.values())
    sys.stdout.write(f"{server.sockets[0].getsockname()[1]}\n")
    sys.stdout.flush()
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(_serve(int(sys.argv[1])))
