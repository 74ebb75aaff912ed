"""Browser page that shows a run in progress: ``page.html``, and the JSON that is sent to it.

The page is one file of plain HTML, CSS and JavaScript without a build or a library: NiceGUI and Panel would bring a web
framework of more than twenty packages to a bench computer for four curves and a table.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Iterator, Sequence
from importlib import resources
from typing import Any

from mcap import records as mcap

from emb_bench.config.bench import parse_bench
from emb_bench.logs.mcap_file import Chunk, message_class
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import BenchFileError
from emb_runtime.estimator.estimate import UNKNOWN, by_name, rows, shares, total
from emb_runtime.records import Reason, RunState

SUBPROTOCOL = "emb-excite.page"
KEPT = 600  # Most chunks that a browser gets when it connects; a chunk has 0.1 s
TOPICS = ("/cycle", "/estimate", "/safety")
RUNNING = (RunState.ACTIVE, RunState.HOMING)
NUMBERS = (*PARAMETER_NAMES, *(f"{name}_deviation" for name in PARAMETER_NAMES))  # Of a message of ``/estimate``
SHIELD = Reason.LIMITED | Reason.RETURNING | Reason.LEFT


def html() -> str:
    """The page."""
    return resources.files("emb_bench.live").joinpath("page.html").read_text(encoding="utf-8")


class Page:
    """Messages to the page, from one log after the other."""

    def __init__(self, empty: str = "") -> None:
        self.begin("", ())
        self._first = json.dumps({"empty": empty})

    @property
    def so_far(self) -> list[str]:
        """Messages of the current log in their order; without a log, the advice."""
        return [self._first, *self._sent]

    def begin(self, name: str, logs: Sequence[str]) -> str:
        """Begin another log; ``logs`` has the names of all that can be shown."""
        self._first = json.dumps({"begin": name, "logs": logs})
        self._sent: deque[str] = deque(maxlen=KEPT)
        self._schemas: dict[int, mcap.Schema] = {}
        self._classes: dict[int, tuple[str, Any]] = {}
        self._start_ns = -1
        self._errors = UNKNOWN  # Systematic errors by the log's bench file
        return self._first

    def know(self, bench: bytes) -> str:
        """Message with the limits of the run's bench file, none if it is refused; stores its systematic errors."""
        try:
            found = parse_bench(bench.decode(), "bench.toml", analysis=True)
        except (BenchFileError, UnicodeDecodeError):
            return self._keep({})
        self._errors, limits = found.systematic, found.limits
        speed, current = limits.velocity, limits.current
        return self._keep({"limits": [limits.angle, (-speed, speed), (-current, current)]})

    def add(self, chunk: Chunk) -> str:
        """Message with samples, estimates and transitions of a chunk; times are seconds since the experiment began.

        Raises:
            TypeError, KeyError, ValueError, AttributeError, google.protobuf.message.DecodeError: it is damaged.
        """
        document: dict[str, Any] = {"cycles": [], "estimates": [], "events": []}
        estimate: dict[str, dict[str, Any]] = {}
        for topic, time_ns, message in self._messages(chunk):
            if topic == "/safety":
                document["events"].append((1e-9 * time_ns, f"{message.code} {message.text}"))
            elif topic == "/estimate":
                estimate = by_name([getattr(message, name) for name in NUMBERS], self._errors)
                repeatability = {name: _number(share) for name, share in shares(estimate).items()}
                document["estimates"].append({"step": message.step, "repeatability": repeatability})
            elif message.state in RUNNING:
                if self._start_ns < 0:
                    self._start_ns = message.receive_time_ns
                    document["start"] = 1e-9 * time_ns
                document["cycles"].append(self._cycle(message))
        return self._keep({**document, "table": [*rows(estimate)], "total": total(shares(estimate), self._errors)})

    def end(self, reason: str) -> str:
        """Message at the end of the log, with the run's exit reason."""
        return self._keep({"result": reason})

    def _messages(self, chunk: Chunk) -> Iterator[tuple[str, int, Any]]:
        """Topic, time [ns] and content of each message in a chunk that the page shows."""
        for record in chunk.described:
            if isinstance(record, mcap.Schema):
                self._schemas[record.id] = record
            elif record.topic in TOPICS and record.schema_id in self._schemas:
                schema = self._schemas[record.schema_id]
                self._classes[record.id] = (record.topic, message_class(schema.name, schema.data))
        for message in chunk.messages():
            if message.channel_id in self._classes:
                topic, factory = self._classes[message.channel_id]
                yield topic, message.publish_time, factory.FromString(message.data)

    def _cycle(self, c: Any) -> dict[str, float | None]:
        return {
            "step": c.step,
            "time": 1e-9 * (c.receive_time_ns - self._start_ns),
            "shield": bool(c.reasons & SHIELD),
            "angle": _number(c.angle),
            "velocity": _number(c.velocity),
            "requested": _number(c.policy_current),
            "sent": _number(c.sent_current),
            "applied": _number(c.applied_current),
        }

    def _keep(self, document: dict[str, Any]) -> str:
        self._sent.append(json.dumps(document))
        return self._sent[-1]


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
