"""A run told in lines: one for every so many samples, with what was measured and sent, and what the actor knows."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from mcap import records as mcap

from emb_bench.logs.columns import message_class
from emb_bench.logs.mcap_file import Chunk
from emb_runtime.estimator.estimate import NORMAL_95
from emb_runtime.log.mcap_schema import CYCLE, ESTIMATE, SAFETY, deviation_of
from emb_runtime.records import Reason, RunState

EVERY = 25  # Samples from one line to the next
TOLD = (CYCLE.name, ESTIMATE, SAFETY.name)
RUNNING = (RunState.ACTIVE, RunState.HOMING)
SHIELD = Reason.LIMITED | Reason.RETURNING | Reason.LEFT


class Lines:
    """The lines of one log after the other.

    Args:
        tell: takes a line.
        every: samples from one line to the next.
    """

    def __init__(self, tell: Callable[[str], None], every: int = EVERY) -> None:
        self._tell = tell
        self._every = every
        self.begin()

    def begin(self) -> None:
        """Another log begins."""
        self._schemas: dict[int, mcap.Schema] = {}
        self._classes: dict[int, tuple[str, Any]] = {}
        self._estimate: Any = None
        self._units: dict[str, str] = {}
        self._shielded = self._samples = 0
        self._start_ns = -1

    def add(self, chunk: Chunk) -> None:
        """Tell what is in a chunk.

        Raises:
            TypeError, KeyError, ValueError, google.protobuf.message.DecodeError: its schemas or messages are damaged.
        """
        for record in chunk.described:
            if isinstance(record, mcap.Schema):
                self._schemas[record.id] = record
            elif record.topic in TOLD and record.schema_id in self._schemas:
                schema = self._schemas[record.schema_id]
                self._classes[record.id] = (record.topic, message_class(schema.name, schema.data))
                if record.topic == ESTIMATE:
                    self._units = dict(json.loads(record.metadata.get("units", "{}")))
        for message in chunk.messages():
            if message.channel_id in self._classes:
                topic, factory = self._classes[message.channel_id]
                self._take(topic, factory.FromString(message.data))

    def _take(self, topic: str, message: Any) -> None:
        if topic == ESTIMATE:
            self._estimate = message
        elif topic == SAFETY.name:
            self._tell(f"{'':8}{message.code}: {message.text}")
        elif message.state in RUNNING:
            if self._start_ns < 0:
                self._start_ns = message.receive_time_ns
            self._samples += 1
            self._shielded += bool(message.reasons & SHIELD)
            if message.step % self._every == 0:
                self._tell(" ".join(self._parts(message)))
                self._shielded = self._samples = 0

    def _parts(self, cycle: Any) -> Iterator[str]:
        yield f"{1e-9 * (cycle.receive_time_ns - self._start_ns):6.3f} s"
        yield f"{cycle.angle:8.2f} rad {cycle.velocity:7.1f} rad/s"
        sent = "  braking" if math.isnan(cycle.sent_current) else f"{cycle.sent_current:+7.3f} A"
        yield sent
        yield f"shield {100 * self._shielded // self._samples:3d} %"
        if self._estimate is not None:
            yield from _known(self._estimate, self._units)


def _known(estimate: Any, units: Mapping[str, str]) -> Iterator[str]:
    """Each parameter's value with its unit, and its 95 % interval, as a part of it."""
    names = [field.name for field in estimate.DESCRIPTOR.fields]
    for name in names:
        if deviation_of(name) in names:
            value, deviation = getattr(estimate, name), getattr(estimate, deviation_of(name))
            part = NORMAL_95 * deviation / abs(value) if value else math.inf
            known = f"{value:.4g} {units.get(name, '')}".rstrip()
            yield f"{name} {known} ± {100 * part:.2g} % (95 %)" if part < 10.0 else f"{name} ?"
