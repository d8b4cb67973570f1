"""Foxglove's live view: a websocket server of the protocol `foxglove.sdk.v1`.

The library sends from threads of its own, and drops the oldest messages for a slow viewer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import foxglove

from service.bridges.messages import MessageOutlet
from storage.formats.writers.mcap_messages import FoxgloveEncoder

if TYPE_CHECKING:
    from storage.formats.writers.mcap_messages import Message


class _FoxgloveChannels:
    """Channels of one node."""

    def __init__(self, context: foxglove.Context) -> None:
        self._context = context
        self._schemas: list[foxglove.Schema] = []
        self._channels: list[foxglove.Channel] = []

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        self._schemas.append(foxglove.Schema(name=name, encoding=encoding, data=data))
        return len(self._schemas) - 1

    def register_channel(
        self, topic: str, message_encoding: str, schema_id: int, metadata: dict[str, str]
    ) -> int:
        channel = foxglove.Channel(
            topic,
            schema=self._schemas[schema_id],
            message_encoding=message_encoding,
            context=self._context,
        )
        self._channels.append(channel)
        return len(self._channels) - 1

    def has_readers(self) -> bool:
        return any(channel.has_sinks() for channel in self._channels)

    def send(self, message: Message) -> None:
        at_ns, number, content = message
        self._channels[number].log(content, log_time=at_ns)

    def close(self) -> None:
        for channel in self._channels:
            channel.close()


class FoxgloveOutlet(MessageOutlet):
    """Websocket server for Foxglove.

    Args:
        host: address to listen on.
        port: port; 0: any.

    Raises:
        UsageError: the address cannot be listened on.
    """

    def __init__(self, host: str, port: int) -> None:
        context = foxglove.Context()
        super().__init__(
            FoxgloveEncoder, ("pressure_raw", "servo_age_us"), lambda _: _FoxgloveChannels(context)
        )
        self._server = foxglove.start_server(name="FootTile", host=host, port=port, context=context)
        self.url = f"ws://{host}:{self._server.port}"
        """Address for viewers."""

    def close(self) -> None:
        """Stop the server."""
        super().close()
        self._server.stop()
