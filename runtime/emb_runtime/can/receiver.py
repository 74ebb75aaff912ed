"""Receiver: pairs valid, fresh and plausible frames to sensor samples, and counts the rejected ones.

Pure: frames with their arrival times go in. Each message of the node has a :class:`MessageState`. Checks of a frame, in
this order:

- kind: a standard data frame. Error frames, echoes of sent frames and other messages are sorted out before. Any other
  frame with the identifier of the command is a second commander's, even a copy of a sent one: the kernel marks an echo.
- length, CRC over data id and payload, alive counter 0..14, reserved bits zero, every signal within its range: a node
  state or stop reason that has no name is none.
- the counter is not that of the last accepted frame. A rejected frame moves no counter, only a leaky count: too many
  in a row stop the run, and a share of more than a fifth.
- an angle and a velocity of one counter make a sample if the device time has moved on, and the angle by what the
  velocities imply (no jump). A rejection counts for the pair.
- period: two of its periods after the last valid frame of any message no current may be commanded until it is back.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final, TypeVar

from emb_runtime.can.codec import FrameRejectedError, Message
from emb_runtime.can.e2e import CounterCheck
from emb_runtime.can.messages import AngleFrame, Layout, StatusFrame, StopReason, VelocityFrame
from emb_runtime.config.bench import Bench
from emb_runtime.records import Frame, NodeState, SensorSample
from emb_runtime.system.clock import TimeUnwrapper

FRESH_PERIODS: Final = 2  # Age of a message, in its own periods, up to which it permits a current

_NEVER: Final = -(1 << 62)

Content = TypeVar("Content", bound=AngleFrame | VelocityFrame | StatusFrame)

# What an error frame reports, by <linux/can/error.h>. It is a message of the kernel, never on the bus. Its identifier
# has one bit per kind of error, so it must be told apart first: the bit of a bus error, 0x080, is also our command.
BUS_OFF: Final = "bus-off"  # The controller has stopped taking part
KINDS: Final = {
    0x001: "transmission timed out",
    0x002: "arbitration lost",
    0x008: "protocol violation",
    0x010: "transceiver problem",
    0x020: "no acknowledgement",
    0x040: BUS_OFF,
    0x080: "bus error",
    0x100: "controller restarted",
}
"""By bit of the identifier."""
CONTROLLER_KINDS: Final = {
    0x01: "controller's receive buffer overflowed",
    0x02: "controller's transmit buffer overflowed",
    0x04: "many receive errors (warning level)",
    0x08: "many transmit errors (warning level)",
    0x10: "error passive by receive errors",
    0x20: "error passive by transmit errors",
    0x40: "error active again",
}
"""By bit of byte 1, where the identifier has the bit of a controller problem."""
WITHOUT_DETAILS: Final = "controller problem without details"
UNKNOWN: Final = "of an unknown class"

_CONTROLLER: Final = 0x004
_COUNTERS: Final = 0x200  # The controller's error counters, which may come alone and are no error then


class Rejection(StrEnum):
    """Reasons to reject the content of a valid frame."""

    REPEATED = "its counter repeats the last one"
    TIME = "its device time does not follow the last one's"
    IMPLAUSIBLE = "the angle does not follow from the last one and the velocities between"


@dataclass
class MessageState:
    """Liveness of a message of the node, or of the pairs that two of them make."""

    name: str
    identifier: int
    fresh_ns: int  # Age up to which the last valid one permits a current [ns]
    errors: CounterCheck  # Follows the counter and counts what was rejected; of a pair the latter only
    valid_ns: int = _NEVER  # Arrival of the last valid one, monotonic [ns]
    rejections: dict[str, int] = field(default_factory=dict)  # Number of rejections, by reason


def classify(frame: Frame) -> tuple[str, ...]:
    """All that an error frame reports; nothing for one that only has the error counters."""
    found = [text for bit, text in KINDS.items() if frame.identifier & bit]
    if frame.identifier & _CONTROLLER:
        status = frame.data[1] if len(frame.data) > 1 else 0
        found += [text for bit, text in CONTROLLER_KINDS.items() if status & bit] or [WITHOUT_DETAILS]
    return tuple(found) or (() if frame.identifier & _COUNTERS else (UNKNOWN,))


def fresh_ns(message: Message) -> int:
    """Age up to which the last valid frame of a message permits a current [ns]."""
    return FRESH_PERIODS * round(message.cycle_time * 1e9)


class Trapezium:
    """Check that an angle follows from the last one by the velocities, within noise and motion.

    Both the exact flow and an Euler step lie within half a period's acceleration of the trapezium. That is at most the
    one that any brake of the bench's shield ranges reaches inside its limits.
    """

    def __init__(self, bench: Bench) -> None:
        noise, sigmas, limits = bench.noise, bench.shield.noise_sigmas, bench.limits
        box = bench.range_set(bench.shield.ranges)
        spring = box.high.gamma * box.high.k_1 * max(-limits.angle[0], limits.angle[1])
        friction = box.high.T_c + box.high.f_v * limits.velocity
        top_acceleration = (box.high.k_m * limits.current + spring + friction) / box.low.J
        self._half_top_acceleration = 0.5 * top_acceleration
        self._angle_noise, self._velocity_noise = sigmas * 1.5 * noise.angle, sigmas * noise.velocity
        self._velocity_noise += bench.sensors.longest_lag(bench.timing.sample_time) * top_acceleration

    def follows(self, last: SensorSample, sample: SensorSample, elapsed: float) -> bool:
        """Returns True if the travelled angle agrees with the mean velocity over the elapsed time [s]."""
        travelled = sample.angle - last.angle
        expected = 0.5 * elapsed * (sample.velocity + last.velocity)
        tolerance = self._angle_noise + elapsed * (self._velocity_noise + elapsed * self._half_top_acceleration)
        return abs(travelled - expected) <= tolerance


class Reception:
    """Checks each frame of the bus, and pairs samples; reports each rejected frame with the reason."""

    def __init__(self, layout: Layout, bench: Bench, on_rejected: Callable[[Frame, str], None]) -> None:
        self._layout = layout
        self._on_rejected = on_rejected
        self._motion = Trapezium(bench)
        self._period_ns = bench.timing.sample_time_ns
        self._angle, self._velocity, self._status = (
            MessageState(m.name, m.identifier, fresh_ns(m), CounterCheck(bench.watch.rejected))
            for m in (layout.angle, layout.velocity, layout.status)
        )
        self._pair = replace(self._velocity, name="pair", errors=CounterCheck(bench.watch.rejected), rejections={})
        self.states = (self._angle, self._velocity, self._status, self._pair)
        """State of each message, and of the pairs: a pair is complete when its velocity has come."""
        self._unwrap = TimeUnwrapper(layout.device_time_period_ns).unwrap
        self._waiting: tuple[AngleFrame, int] | None = None  # Angle without its velocity, and its arrival [ns]
        self._last: SensorSample | None = None
        self.rejected = 0  # Frames rejected so far
        self.too_many_rejected = False  # Too many, in a row or by their share: the source is not trusted again
        self.foreign_command = False  # Somebody else has sent our command message
        self.status: StatusFrame | None = None  # The node's latest
        self.dropped = 0  # Frames that the kernel dropped for want of buffer
        self.bus_errors: Counter[str] = Counter()
        """Reports of the CAN controller, by :func:`classify`."""

    @property
    def stop_reason(self) -> StopReason | None:
        """Reason for which the node does not obey, by its latest status; None if it obeys or there is no status."""
        status = self.status
        return None if status is None or status.node_state is NodeState.ACTIVE else status.stop_reason

    @property
    def pairing_problem(self) -> str:
        """Reason why angle and velocity frames have never paired; "" if they have, or one is missing."""
        if self._last is not None or _NEVER in (self._angle.valid_ns, self._velocity.valid_ns):
            return ""
        return "angle and velocity frames came, but no velocity next after the angle with its counter: that goes first"

    def inhibit_reason(self, now_ns: int) -> str:
        """Reason why no current may be commanded now [ns]; "" if one may."""
        # Another transport's clock may put a stamp just ahead of now.
        ahead_ns = -self._period_ns
        for state in self.states:
            if not ahead_ns <= now_ns - state.valid_ns <= state.fresh_ns:
                return _overdue(state, now_ns)
        if self.foreign_command:
            return "somebody else has sent a command"
        return "too many frames were rejected" if self.too_many_rejected else ""

    def rejections(self) -> dict[str, dict[str, int]]:
        """Number of rejections by message and reason, without those that never happened."""
        return {state.name: dict(state.rejections) for state in self.states if state.rejections}

    def add_frame(self, frame: Frame) -> SensorSample | None:
        """Add one frame; gives a sample when it completes a valid pair."""
        if frame.dropped > self.dropped:
            self.dropped = frame.dropped
        if frame.error:
            self.bus_errors.update(classify(frame))
            return None
        if frame.own or frame.extended:
            return None
        identifier, layout = frame.identifier, self._layout
        if identifier == layout.angle.identifier:
            if (angle := self._accepted(frame, self._angle, layout.decode_angle)) is not None:
                self._waiting = angle, frame.time_ns
        elif identifier == layout.velocity.identifier:
            if (velocity := self._accepted(frame, self._velocity, layout.decode_velocity)) is not None:
                return self._paired(frame, velocity)
        elif identifier == layout.status.identifier:
            self.status = self._accepted(frame, self._status, layout.decode_status) or self.status
        elif identifier == layout.command.identifier:
            self.foreign_command = True
        return None

    def _accepted(self, frame: Frame, state: MessageState, decode: Callable[[Frame], Content]) -> Content | None:
        """Content of a frame that is valid and new; None of one that is rejected."""
        try:
            content = decode(frame)
        except FrameRejectedError as err:
            state.errors.reject()
            self._count_rejected(frame, state, err.fault, str(err))
            return None
        if state.errors.advance(content.counter) == 0:
            self._count_rejected(frame, state, Rejection.REPEATED, Rejection.REPEATED)
            return None
        state.valid_ns = frame.time_ns
        return content

    def _paired(self, frame: Frame, velocity: VelocityFrame) -> SensorSample | None:
        """The sample of a velocity and the angle that waits for it; None if there is none, or it does not follow."""
        counter, speed, applied_current, node_state, command_counter = velocity
        waiting, pair, now_ns = self._waiting, self._pair, frame.time_ns
        # An angle that has waited long is of another round of the counter: 15 periods old, and of no use.
        if waiting is None or waiting[0].counter != counter or abs(now_ns - waiting[1]) > pair.fresh_ns:
            return None  # the missing pair is counted by its time
        self._waiting = None
        angle, since_ns = waiting
        times = self._unwrap(angle.device_time_ns, since_ns), (now_ns if now_ns > since_ns else since_ns)
        sample = tuple.__new__(
            SensorSample, (counter, angle.angle, speed, *times, applied_current, command_counter, node_state)
        )
        if (reason := self._contradiction(sample)) is not None:
            pair.errors.reject()
            self._count_rejected(frame, pair, reason, reason)
            return None
        self._last = sample
        pair.valid_ns = sample.receive_time_ns
        pair.errors.forgive()
        return sample

    def _contradiction(self, sample: SensorSample) -> Rejection | None:
        """Reason why a sample cannot follow the last one; None if it can, as the first does."""
        if self._last is None:
            return None
        elapsed_ns = sample.device_time_ns - self._last.device_time_ns
        if elapsed_ns < self._period_ns // 2:
            return Rejection.TIME
        return None if self._motion.follows(self._last, sample, elapsed_ns * 1e-9) else Rejection.IMPLAUSIBLE

    def _count_rejected(self, frame: Frame, state: MessageState, reason: str, why: str) -> None:
        self.rejected += 1
        state.rejections[reason] = state.rejections.get(reason, 0) + 1
        if state.errors.exceeded:
            self.too_many_rejected = True
        self._on_rejected(frame, why)


def _overdue(state: MessageState, now_ns: int) -> str:
    age_ns = now_ns - state.valid_ns
    if state.valid_ns == _NEVER:
        return f"{state.name} has not come yet"
    if age_ns < 0:
        return f"{state.name} is stamped {-age_ns / 1e6:.3f} ms ahead of now"
    return f"{state.name} is overdue: the last valid one is {age_ns / 1e6:.3f} ms old"
