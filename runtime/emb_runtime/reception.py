"""From frames to sensor samples: what is valid, fresh, paired and plausible, and the count of what is not.

Pure: frames with their arrival times go in. An angle and a velocity frame of the same counter make a sample; a frame
that fails its CRC, length, range or counter is rejected, and so is a pair whose angle does not follow from the last
one and the velocities between. Rejected frames change nothing but a leaky count.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

from emb_runtime.bench import Bench
from emb_runtime.clock import TimeUnwrapper
from emb_runtime.e2e import CounterCheck
from emb_runtime.frames import AngleFrame, FrameRejectedError, Layout, StatusFrame, VelocityFrame
from emb_runtime.records import Frame, SensorSample


class Rejection(Enum):
    """Why the content of a valid frame was not believed."""

    REPEATED = "its counter repeats the last one"
    TIME = "its device time does not follow the last one's"
    IMPLAUSIBLE = "the angle does not follow from the last one and the velocities between"


class Reception:
    """Takes every frame that was on the bus, and gives the samples.

    Args:
        layout: the bus layout.
        bench: noise, ranges and limits, which say what is plausible, and how many rejections are too many.
        on_rejected: told what was rejected and why, in words.
    """

    def __init__(self, layout: Layout, bench: Bench, on_rejected: Callable[[Frame, str], None]) -> None:
        self._layout = layout
        self._on_rejected = on_rejected
        self._noise = bench.noise
        self._sigmas = bench.shield.noise_sigmas
        self._period_ns = bench.timing.sample_time_ns
        box = bench.range_set(bench.shield.ranges)
        spring = box.high.gamma * box.high.k_1 * max(-bench.limits.angle[0], bench.limits.angle[1])
        friction = box.high.T_c + box.high.f_v * bench.limits.velocity
        self._top_acceleration = (box.high.k_m * bench.limits.current + spring + friction) / box.low.J
        self._tolerated = bench.watch.rejected
        self._angle_check = CounterCheck(saturation=self._tolerated)
        self._velocity_check = CounterCheck(saturation=self._tolerated)
        self._unwrap = TimeUnwrapper(layout.device_time_period_ns)
        self._implausible = 0
        self._angle: tuple[AngleFrame, int] | None = None
        self._last: SensorSample | None = None
        self.rejected = 0
        """Frames rejected so far."""
        self.foreign_command = False
        """Somebody else has sent our command message."""
        self.status: StatusFrame | None = None
        """The node's latest status."""
        self.dropped = 0
        """Frames that the kernel dropped for want of buffer."""

    @property
    def too_many_rejected(self) -> bool:
        """Whether so many frames were rejected, with so few good ones between, that the source is not to be trusted."""
        worst = max(self._angle_check.errors, self._velocity_check.errors, self._implausible)
        return worst >= self._tolerated

    def take(self, frame: Frame) -> SensorSample | None:
        """Take one frame; gives a sample when it completes a valid pair."""
        self.dropped = max(self.dropped, frame.dropped)
        if frame.own or frame.error or frame.extended:
            return None
        layout = self._layout
        if frame.identifier == layout.angle.identifier:
            self._take_angle(frame)
        elif frame.identifier == layout.velocity.identifier:
            return self._take_velocity(frame)
        elif frame.identifier == layout.status.identifier:
            self._take_status(frame)
        elif frame.identifier == layout.command.identifier:
            self.foreign_command = True
        return None

    def _take_angle(self, frame: Frame) -> None:
        try:
            angle = self._layout.decode_angle(frame)
        except FrameRejectedError as err:
            self._reject(frame, str(err), self._angle_check)
            return
        if self._angle_check.step(angle.counter) == 0:
            self._reject(frame, Rejection.REPEATED.value)
            return
        self._angle = (angle, frame.time_ns)

    def _take_velocity(self, frame: Frame) -> SensorSample | None:
        try:
            velocity = self._layout.decode_velocity(frame)
        except FrameRejectedError as err:
            self._reject(frame, str(err), self._velocity_check)
            return None
        if self._velocity_check.step(velocity.counter) == 0:
            self._reject(frame, Rejection.REPEATED.value)
            return None
        if self._angle is None or self._angle[0].counter != velocity.counter:
            return None  # the angle frame of this pair did not come; the missing pair is counted by its time
        angle, arrival_ns = self._angle
        self._angle = None
        return self._judged(frame, self._paired(angle, velocity, arrival_ns, frame.time_ns))

    def _take_status(self, frame: Frame) -> None:
        try:
            self.status = self._layout.decode_status(frame)
        except FrameRejectedError as err:
            self._reject(frame, str(err))

    def _paired(
        self, angle: AngleFrame, velocity: VelocityFrame, angle_arrival_ns: int, velocity_arrival_ns: int
    ) -> SensorSample:
        return SensorSample(
            counter=angle.counter,
            angle=angle.angle,
            velocity=velocity.velocity,
            device_time_ns=self._unwrap.unwrap(angle.device_time_ns, angle_arrival_ns),
            receive_time_ns=max(angle_arrival_ns, velocity_arrival_ns),
            applied_current=velocity.applied_current,
            command_counter=velocity.command_counter,
            node_state=velocity.node_state,
        )

    def _judged(self, frame: Frame, sample: SensorSample) -> SensorSample | None:
        """The sample if it follows from the last one; the first is believed."""
        last = self._last
        if last is not None:
            elapsed_ns = sample.device_time_ns - last.device_time_ns
            if elapsed_ns < self._period_ns // 2:
                self._doubt(frame, Rejection.TIME)
                return None
            if not self.follows(last, sample, elapsed_ns * 1e-9):
                self._doubt(frame, Rejection.IMPLAUSIBLE)
                return None
        self._last = sample
        self._implausible = max(0, self._implausible - 1)
        return sample

    def follows(self, last: SensorSample, sample: SensorSample, elapsed: float) -> bool:
        """Whether the travelled angle agrees with the mean velocity (trapezium) as far as noise and motion allow.

        Both the exact flow and an Euler step lie within half a period's acceleration of the trapezium.
        """
        travelled = sample.angle - last.angle
        expected = 0.5 * elapsed * (sample.velocity + last.velocity)
        tolerance = self._sigmas * (1.5 * self._noise.angle + elapsed * self._noise.velocity)
        return abs(travelled - expected) <= tolerance + 0.5 * self._top_acceleration * elapsed * elapsed

    def _doubt(self, frame: Frame, why: Rejection) -> None:
        self._implausible = min(self._tolerated, self._implausible + 1)
        self._reject(frame, why.value)

    def _reject(self, frame: Frame, why: str, check: CounterCheck | None = None) -> None:
        self.rejected += 1
        if check is not None:
            check.reject()
        self._on_rejected(frame, why)
