"""The chunks of logs for Foxglove and Lichtblick, over the Foxglove WebSocket protocol."""

from __future__ import annotations

import time
from typing import Any

from mcap import records as mcap

from emb_bench.logs.chunks import Chunk
from emb_runtime.errors import UsageError

HOST = "127.0.0.1"
PORT = 8765  # Port that viewers propose
SUBSCRIBING = 0.1  # Time for viewers to subscribe to new topics before their first message [s]
LINGER = 0.2  # Time for viewers to get the last messages [s]
BACKLOG = 1 << 14  # Messages that wait for a slow viewer; a chunk has about a thousand. Then its oldest are left out.


class Server:
    """A server of one log after the other; a topic keeps its channel where its schema stays the same.

    Args:
        host: address to listen at.
        port: to listen at; 0 for any that is free.

    Raises:
        UsageError: foxglove-sdk is not installed, or the port cannot be had.
    """

    def __init__(self, host: str = HOST, port: int = PORT) -> None:
        try:
            import foxglove
        except ImportError as err:
            raise UsageError("a viewer's server needs foxglove-sdk: pip install 'emb-excite[live]'") from err
        self._foxglove: Any = foxglove
        self._channels: dict[tuple[str, bytes], Any] = {}
        self._schemas: dict[int, mcap.Schema] = {}
        self._of_log: dict[int, Any] = {}
        try:
            self._server = foxglove.start_server(name="emb-excite", host=host, port=port, message_backlog_size=BACKLOG)
        except (RuntimeError, OSError, OverflowError) as err:
            raise UsageError(f"the server cannot listen at {host}:{port}: {err}") from err
        self.address = f"ws://{host}:{self._server.port}"
        """Address for a viewer."""

    def begin(self) -> None:
        """Another log begins: its numbers of channels and schemas are its own."""
        self._schemas.clear()
        self._of_log.clear()

    def add(self, chunk: Chunk) -> None:
        """Serve the messages of a chunk. Their time is the one at which they happened, not that of their writing."""
        before = set(self._channels)
        for record in chunk.described:
            if isinstance(record, mcap.Schema):
                self._schemas[record.id] = record
            elif record.id not in self._of_log and record.schema_id in self._schemas:
                self._of_log[record.id] = self._channel(record, self._schemas[record.schema_id])
        if set(self._channels) != before:
            time.sleep(SUBSCRIBING)
        for message in chunk.messages():
            if (channel := self._of_log.get(message.channel_id)) is not None:
                channel.log(message.data, log_time=message.publish_time)

    def _channel(self, channel: mcap.Channel, schema: mcap.Schema) -> Any:
        known = (channel.topic, schema.data)
        if known not in self._channels:
            for topic, data in [old for old in self._channels if old[0] == channel.topic]:
                self._channels.pop((topic, data)).close()
            self._channels[known] = self._foxglove.Channel(
                channel.topic,
                message_encoding=channel.message_encoding,
                schema=self._foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data),
                metadata=channel.metadata,
            )
        return self._channels[known]

    def close(self) -> None:
        """End the server, once viewers had time for the last messages."""
        time.sleep(LINGER)
        for channel in self._channels.values():
            channel.close()
        self._server.stop()
