"""Records of a run from its log, in the one order in which the loop made them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from emb_bench.logs import learnt
from emb_bench.logs.estimates import by_step
from emb_bench.logs.log import RunLog
from emb_runtime.can.messages import Layout
from emb_runtime.can.receiver import Reception
from emb_runtime.config.bench import Bench
from emb_runtime.control.start_conditions import READY_PAIRS
from emb_runtime.control.stop_condition import REACHED
from emb_runtime.errors import FrameError, LogError
from emb_runtime.log.ring_buffer import EventRecord
from emb_runtime.records import CycleRecord, Frame, RunState, SensorSample
from emb_runtime.safety.guard import OLDEST_SAMPLE_PERIODS
from emb_runtime.safety.state_machine import FAULTS

Item = Frame | CycleRecord | EventRecord

SOFT = frozenset(fault.name for fault, info in FAULTS.items() if not info.latched)  # Events of faults that pass
LATCHED = frozenset(fault.name for fault, info in FAULTS.items() if info.latched)  # Events of faults that end a run
RUNS_ON = frozenset({RunState.ACTIVE.name, RunState.HOMING.name, "FRAME_REJECTED", REACHED, *SOFT})
"""Events that a cycle may follow which began before them."""


@dataclass(frozen=True)
class Trace:
    """Records of a run, in the order in which the loop made them; times are monotonic [ns]."""

    items: tuple[Item, ...]
    pauses: Mapping[int, int]
    """End of each wait while the run was stopping: stop frames tried so far -> items taken so far."""
    estimates: Mapping[int, tuple[float, ...]]
    """Estimates of the actor, by step: values, then their standard deviations."""
    learnt: Mapping[int, tuple[float, ...]]
    """Brakes and states that the shield had left as possible, by step, see :mod:`emb_bench.logs.learnt`."""
    listening_ns: int
    """Earliest time that the clock shows before the run arms [ns]. The run was catching up with old frames until its
    first pair of the row that armed it: so that no earlier pair begins the row, the clock shows the latest time at
    which that one still counts. Of a run that did not arm, the time at which it began to listen."""

    @property
    def last_ns(self) -> int:
        """Time of the latest thing recorded [ns]."""
        return max(map(_time_ns, self.items))


def read_trace(log: RunLog) -> Trace:
    """The trace of a log.

    Raises:
        LogError: the log has no bench, layout, clock or control cycles, topics with other fields, or not the beginning
            of the run.
    """
    offset_ns = log.wall_offset_ns
    cycles, safety = log.cycles, log.tables.get("/safety", {})
    frames = [order for topic in ("/can/rx", "/can/tx") for order in _column(log.tables.get(topic, {}), "order")]
    rows = zip(*(_column(cycles, name) for name in CycleRecord._fields), strict=True)
    events = [EventRecord(event.time_ns - offset_ns, event.code, event.text) for event in log.events]
    ordered: list[tuple[int, Item]] = list(zip(sorted(frames), log.frames, strict=True))
    ordered += zip(_column(cycles, "order"), map(CycleRecord._make, rows), strict=True)
    ordered += zip(_column(safety, "order"), events, strict=True)
    ordered.sort(key=lambda pair: pair[0])
    items = tuple(item for _, item in ordered)
    if not items or not isinstance(items[0], EventRecord) or items[0].code != RunState.SILENT.name:
        raise LogError(f"{log.path}: the beginning of the run is not in this log, and a rerun starts there")
    samples = _samples(items, log.layout, log.bench)
    return Trace(
        items=items,
        pauses=_pauses(items, samples, log.layout),
        estimates=by_step(log),
        learnt=learnt.by_step(log),
        listening_ns=_listening_ns(items, samples, log.bench.timing.sample_time_ns),
    )


def _column(table: Mapping[str, Any], name: str) -> list[Any]:
    return list(table[name].tolist()) if name in table else []


def _time_ns(item: Item) -> int:
    return item.receive_time_ns if isinstance(item, CycleRecord) else item.time_ns


def _samples(items: tuple[Item, ...], layout: Layout, bench: Bench) -> dict[int, SensorSample]:
    """The sensor samples, by the index of the frame that completed each."""
    reception = Reception(layout, bench, lambda _frame, _why: None)
    taken = ((n, reception.take(item)) for n, item in enumerate(items) if isinstance(item, Frame))
    return {n: sample for n, sample in taken if sample is not None}


def _where(items: tuple[Item, ...], code: str) -> int | None:
    return next((n for n, item in enumerate(items) if isinstance(item, EventRecord) and item.code == code), None)


def _listening_ns(items: tuple[Item, ...], samples: Mapping[int, SensorSample], period_ns: int) -> int:
    """See :attr:`Trace.listening_ns`."""
    armed = _where(items, RunState.ARMED.name)
    if armed is None:
        return _time_ns(items[0])
    ready = [sample for n, sample in samples.items() if n < armed][-READY_PAIRS:]
    return min([_time_ns(items[armed]), *(s.receive_time_ns + OLDEST_SAMPLE_PERIODS * period_ns for s in ready[:1])])


def _pauses(items: tuple[Item, ...], samples: Mapping[int, SensorSample], layout: Layout) -> dict[int, int]:
    """Ends of the waits after the stop frames.

    A stop frame names the newest sample that the loop had when it sent it, so frames that lie between that sample's
    successor and the stop frame's echo had not been taken yet. The wait after the last one has no such mark.
    Nothing depends on its end, except that the loop then listened until a sample reported idle and a status the reason.
    """
    begin = _where(items, RunState.STOPPING.name)
    if begin is None:
        return {}
    sent: list[int] = []
    newest: list[int | None] = [next((s.counter for n, s in reversed([*samples.items()]) if n <= begin), None)]
    for n in range(begin + 1, len(items)):
        item = items[n]
        if isinstance(item, EventRecord) and item.code == "STOP_FRAME_NOT_SENT":
            sent.append(n)
        elif isinstance(item, Frame) and item.own and (answers := _answers(item, layout)) is not None:
            first = sent[-1] if sent else begin + 1
            sent.append(max((at for at in range(first, n + 1) if newest[at - begin - 1] == answers), default=n))
        newest.append(samples[n].counter if n in samples else newest[-1])
    pauses = dict(enumerate(sent[1:], start=1))
    over = _where(items, RunState.OVER.name)
    if sent and over is not None:
        heard = [n for n in samples if begin < n < over]
        reported = [n for n in range(begin + 1, over) if _is_status(items[n], layout)]
        if marks := heard[-1:] + reported[-1:]:
            pauses[len(sent)] = min(marks)
    return pauses


def _is_status(item: Item, layout: Layout) -> bool:
    return isinstance(item, Frame) and item.identifier == layout.status.identifier and not item.error


def _answers(frame: Frame, layout: Layout) -> int | None:
    """Counter of the sample that a stop frame answers; None for any other frame."""
    try:
        command = layout.decode_command(frame)
    except FrameError:
        return None
    return None if command.enable else command.answers
