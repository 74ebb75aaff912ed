"""Statistics of a bus: frames go in; counts, rates and the scatter of the sensors come out. Sends nothing."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from emb_runtime.can.codec import worst_bits
from emb_runtime.can.messages import Layout, StatusFrame
from emb_runtime.can.receiver import Reception
from emb_runtime.config.bench import Bench
from emb_runtime.control.start_conditions import READY_PAIRS
from emb_runtime.records import Frame, NodeState, SensorSample
from emb_runtime.system.clock import Clock

if TYPE_CHECKING:
    from emb_runtime.drives.mapping import Mapping as DriveMapping

ENOUGH_PAIRS = 200  # Sensor pairs for a standard deviation with an error of 5 %
RECENT_PAIRS = 4000  # Most pairs for the scatter
OTHERS_BITS = worst_bits(8)  # Bits of a foreign frame, counted as one of 8 bytes with an 11-bit identifier


def planned_load(bench: Bench, layout: Layout, drive: DriveMapping | None) -> float:
    """Worst-case load of the bus by a run, 1.0 being full; of a mapped drive's bus, if there is one."""
    return layout.bus_load(bench.can.bitrate) if drive is None else drive.bus_load(bench.timing.sample_time)


class Scatter(NamedTuple):
    """Scatter of the sensors at rest."""

    pairs: int  # Number of pairs, the newest ones of an idle node
    angle: float  # Standard deviation; NaN for fewer than two pairs [rad]
    velocity: float  # [rad/s]


@dataclass(frozen=True)
class BusStatistics:
    """Statistics of a bus."""

    duration: float  # Time from the first frame to the last [s]
    frames: Mapping[str, int]  # Frames by message name
    rates: Mapping[str, float]  # Mean rate by message name, of those seen at least twice [1/s]
    others: int  # Data and remote frames that are not in the DBC
    load: float
    """Bus load by all frames, with the largest possible number of stuff bits."""
    rejections: Mapping[str, Mapping[str, int]]  # Rejections as in :class:`~emb_runtime.control.result.Outcome`
    distrusted: bool  # True after so many rejections that a run would have been stopped
    bus_errors: Mapping[str, int]  # Bus errors as in :class:`~emb_runtime.control.result.Outcome`
    dropped: int  # Frames that the kernel dropped
    commanded: bool  # Another sender commands the node
    pairing_problem: str  # :attr:`~emb_runtime.can.receiver.Reception.pairing_problem`
    pairs: int  # Valid sensor pairs
    missing: int  # Pairs that did not come, by the node's clock
    period: float  # Median time between samples by the node's clock [s]; NaN with fewer than two
    scatter: Scatter
    status: StatusFrame | None  # The node's latest
    sample: SensorSample | None  # The newest valid one

    def document(self) -> dict[str, Any]:
        """The statistics as plain data."""
        records = {
            name: record and {key: getattr(value, "name", value) for key, value in record._asdict().items()}
            for name, record in (("scatter", self.scatter), ("status", self.status), ("sample", self.sample))
        }
        return asdict(self) | records


class Seen(NamedTuple):
    """Frames of one message that were seen."""

    frames: int
    first_ns: int  # Monotonic [ns]
    last_ns: int

    def rate(self) -> float:
        """Mean rate of two frames or more [1/s]."""
        return (self.frames - 1) / (self.last_ns - self.first_ns) * 1e9


class BusMonitor:
    """Monitor of a bus: counts its frames; reports each rejected one with the reason."""

    def __init__(self, layout: Layout, bench: Bench, on_rejected: Callable[[Frame, str], None]) -> None:
        self._bench = bench
        self._layout = layout
        self._names = {message.identifier: message.name for message in layout.all_messages}
        self._reception = Reception(layout, bench, on_rejected)
        self._seen: dict[str | None, Seen] = {}  # By message name; None for frames that are not in the DBC
        self._periods_ns: deque[int] = deque(maxlen=RECENT_PAIRS)
        self._at_rest: deque[tuple[float, float]] = deque(maxlen=RECENT_PAIRS)
        self._missing = 0
        self.pairs = 0  # Valid pairs so far
        self.sample: SensorSample | None = None  # The newest one

    @property
    def status(self) -> StatusFrame | None:
        """The node's latest status."""
        return self._reception.status

    def add_frame(self, frame: Frame) -> SensorSample | None:
        """Add one frame; returns a sample if it completes a valid pair."""
        if not frame.error:
            name = None if frame.extended else self._names.get(frame.identifier)
            frames, first_ns, last_ns = self._seen.get(name, (0, frame.time_ns, frame.time_ns))
            self._seen[name] = Seen(frames + 1, first_ns, max(last_ns, frame.time_ns))
        sample = self._reception.add_frame(frame)
        if sample is not None:
            self._follow(sample)
        return sample

    def add_old_frame(self, frame: Frame) -> None:
        """Add a frame from before the monitor began: it counts only if it is alarming."""
        if is_alarming(frame, self._layout):
            self._reception.add_frame(frame)

    def statistics(self) -> BusStatistics:
        """Statistics so far."""
        reception, seen = self._reception, self._seen
        spans = seen.values()
        duration = (max(s.last_ns for s in spans) - min(s.first_ns for s in spans)) * 1e-9 if seen else 0.0
        named = {name: s for name, s in seen.items() if name is not None}
        frames, others = {name: s.frames for name, s in named.items()}, seen[None].frames if None in seen else 0
        bits = OTHERS_BITS * others + sum(m.worst_bits * frames.get(m.name, 0) for m in self._layout.all_messages)
        enough = len(self._at_rest) > 1
        scatter = map(statistics.stdev, zip(*self._at_rest, strict=True)) if enough else (math.nan, math.nan)
        return BusStatistics(
            duration=duration,
            frames=frames,
            rates={name: s.rate() for name, s in named.items() if s.last_ns > s.first_ns},
            others=others,
            load=bits / duration / self._bench.can.bitrate if duration > 0.0 else 0.0,
            rejections=reception.rejections(),
            distrusted=reception.too_many_rejected,
            bus_errors=dict(reception.bus_errors),
            dropped=reception.dropped,
            commanded=reception.foreign_command,
            pairing_problem=reception.pairing_problem,
            pairs=self.pairs,
            missing=self._missing,
            period=statistics.median(self._periods_ns) * 1e-9 if self._periods_ns else math.nan,
            scatter=Scatter(len(self._at_rest), *scatter),
            status=reception.status,
            sample=self.sample,
        )

    def _follow(self, sample: SensorSample) -> None:
        before, self.sample = self.sample, sample
        self.pairs += 1
        if sample.node_state is NodeState.IDLE:
            self._at_rest.append((sample.angle, sample.velocity))
        else:
            self._at_rest.clear()
        if before is not None:
            elapsed_ns = sample.device_time_ns - before.device_time_ns
            self._periods_ns.append(elapsed_ns)
            self._missing += max(0, round(elapsed_ns / self._bench.timing.sample_time_ns) - 1)


def is_alarming(frame: Frame, layout: Layout) -> bool:
    """Returns True for a frame that counts at any age: an error of the controller, or a command of another sender."""
    return frame.error or (frame.identifier == layout.command.identifier and not (frame.own or frame.extended))


def listen(
    monitor: BusMonitor,
    receive: Callable[[int], Frame | None],
    clock: Clock,
    period_ns: int,
    deadline_ns: int,
    enough: Callable[[SensorSample, int], bool],
    stop_requested: Callable[[], bool],
) -> None:
    """Listen until enough pairs have come and the last of them are good enough, or until a deadline.

    Frames from before the call may have waited in the kernel for long: of these only alarming frames count.

    Args:
        monitor: takes the frames.
        receive: gives the next frame, or None at a deadline.
        clock: clock of these deadlines.
        period_ns: the sampling period [ns].
        deadline_ns: monotonic [ns].
        enough: True if a sample, received at a time (monotonic [ns]), is good.
        stop_requested: True if the operator has ended the command.
    """
    begin_ns = now_ns = clock.now_ns()
    ready = 0
    while now_ns < deadline_ns and not stop_requested() and (ready < READY_PAIRS or monitor.pairs < ENOUGH_PAIRS):
        frame = receive(min(deadline_ns, now_ns + 10 * period_ns))
        now_ns = clock.now_ns()
        if frame is None:
            continue
        if frame.time_ns < begin_ns:
            monitor.add_old_frame(frame)
        elif (sample := monitor.add_frame(frame)) is not None:
            ready = ready + 1 if enough(sample, now_ns) else 0
