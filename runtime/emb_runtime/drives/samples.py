"""Samples of a drive: their times on a grid that follows their arrivals, the age of answers, and what they may show."""

from __future__ import annotations

import math

from emb_runtime.can.e2e import NO_COUNTER, LeakyCount
from emb_runtime.can.receiver import Trapezium
from emb_runtime.config.bench import Bench
from emb_runtime.drives.mapping import Mapping
from emb_runtime.drives.wire import DriveSample
from emb_runtime.records import NodeState, SensorSample

AGE_TOLERANCE = 0.1
"""Part of a period by which an answer may act later than ``shield.frame_age`` declares: its clock is the poll's."""
GRID_GAIN = 1.0 / 32.0  # Part of a sample's deviation from the grid by which the grid follows
CONTRADICTIONS = 3  # Samples in a row that contradict the one before, or a share of them, by which a drive is let go


class SampleTimes:
    """Times of one drive's samples, which it does not stamp, and of their answers."""

    def __init__(self, mapping: Mapping, bench: Bench) -> None:
        self._is_polled = mapping.polled
        self._frame_age = bench.shield.frame_age
        self._period_ns = bench.timing.sample_time_ns
        bits = max(mapping.messages[name].worst_bits for name in mapping.sensor_messages)
        bits += mapping.messages[mapping.command.message].worst_bits
        self._bus_ns = 0 if mapping.polled else round(bits / mapping.bitrate * 1e9)
        self._grid_ns: float | None = None
        self._first_ns = self._polled_ns = self._measured_ns = 0
        self.largest_age_ns = 0
        """Longest time from a measurement until its answer acted, as far as this computer sees it [ns]: since the poll
        that requested it; else since its place on the grid, plus the time of the frames on the bus."""
        self.largest_jitter_ns = 0
        """Largest deviation of a sample's arrival from the grid [ns]."""

    @property
    def too_late(self) -> str:
        """Excess of the measured age over the bench's ``shield.frame_age``, in words; empty for nothing."""
        (low, high), periods = self._frame_age, self.largest_age_ns / self._period_ns
        if periods <= high + AGE_TOLERANCE:
            return ""
        return (
            f"an answer acted {periods:.2f} periods after its measurement, shield.frame_age = [{low}, {high}] declares "
            f"less: declare [{low}, {math.ceil(periods - AGE_TOLERANCE)}], or make bus and computer faster"
        )

    def add_sample(self, time_ns: int) -> int:
        """Add a sample's arrival; gives its time since the first [ns]: on the grid, or as it came if polled."""
        if self._grid_ns is None:
            self._grid_ns = float(time_ns)
            self._first_ns = time_ns
        else:
            periods = max(1, round((time_ns - self._grid_ns) / self._period_ns))
            expected_ns = self._grid_ns + periods * self._period_ns
            late_ns = time_ns - expected_ns
            # A polled drive answers at once: its samples are on the grid of the polls.
            self._grid_ns = float(time_ns) if self._is_polled else expected_ns + GRID_GAIN * late_ns
            self.largest_jitter_ns = max(self.largest_jitter_ns, round(abs(late_ns)))
        self._measured_ns = self._polled_ns if self._is_polled else min(time_ns, round(self._grid_ns))
        return round(self._grid_ns) - self._first_ns + self._period_ns

    def polled(self, now_ns: int) -> None:
        """Note a poll [ns]: the next sample is its answer."""
        self._polled_ns = now_ns

    def acted(self, now_ns: int) -> None:
        """Note that the answer to the newest sample leaves [ns]."""
        self.largest_age_ns = max(self.largest_age_ns, now_ns - self._measured_ns + self._bus_ns)


class SensorCheck:
    """Check that the angle follows from the velocity, and that both are within the bench's limits and noise."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._motion = Trapezium(bench)
        self._last: SensorSample | None = None
        self.contradictions = LeakyCount(CONTRADICTIONS)

    def update(self, sample: DriveSample, device_ns: int) -> None:
        """Take a sample and its time since the first [ns]."""
        angle, velocity, _, time_ns = sample
        last = self._last
        self._last = SensorSample(0, angle, velocity, device_ns, time_ns, 0.0, NO_COUNTER, NodeState.IDLE)
        if last is None or self._motion.follows(last, self._last, (device_ns - last.device_time_ns) * 1e-9):
            self.contradictions.forgive()
        else:
            self.contradictions.reject()

    def is_outside(self, sample: DriveSample) -> bool:
        """Returns True if the brake has left its limits."""
        noise, sigmas, (low, high) = self._bench.noise, self._bench.shield.noise_sigmas, self._bench.limits.angle
        is_inside = low - sigmas * noise.angle <= sample.angle <= high + sigmas * noise.angle
        return not (is_inside and abs(sample.velocity) <= self._bench.limits.velocity + sigmas * noise.velocity)
