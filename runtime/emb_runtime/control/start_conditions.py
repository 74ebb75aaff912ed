"""Conditions under which a run may begin, and what is home: for the pre-flight, and for each sample in the loop."""

from __future__ import annotations

from emb_runtime.can.messages import Layout, StatusFrame, bench_identity
from emb_runtime.config.bench import Bench
from emb_runtime.records import NodeState, SensorSample
from emb_runtime.safety.guard import OLDEST_SAMPLE_PERIODS

READY_PAIRS = 10  # Valid pairs in a row, idle and where the run may begin, before the loop arms


class Bounds:
    """The bench's limits and its home, widened for a measurement by the bench's noise."""

    def __init__(self, bench: Bench) -> None:
        noise, shield, limits = bench.noise, bench.shield, bench.limits
        angle, velocity = shield.noise_sigmas * noise.angle, shield.noise_sigmas * noise.velocity
        self._home_angle, self._home_velocity = shield.home_angle + angle, shield.home_velocity + velocity
        self._low, self._high = limits.angle[0] - angle, limits.angle[1] + angle
        self._fastest = limits.velocity + velocity
        self._limits = limits

    def is_home(self, sample: SensorSample) -> bool:
        """Returns True if a brake with this measurement may be at rest at the origin."""
        return abs(sample.angle) <= self._home_angle and abs(sample.velocity) <= self._home_velocity

    def outside(self, sample: SensorSample) -> str:
        """Reason why the brake is outside its limits; empty if it is inside."""
        low, high = self._limits.angle
        if not self._low <= sample.angle <= self._high:  # this way round, NaN is outside
            return f"angle {sample.angle:.2f} rad, limits {low:g} to {high:g} rad"
        if not abs(sample.velocity) <= self._fastest:
            return f"velocity {sample.velocity:.1f} rad/s, limit {self._limits.velocity:g} rad/s"
        return ""


class StartConditions:
    """Conditions that a node must meet before a run may begin; with ``anywhere`` the brake need not be at home."""

    def __init__(self, bench: Bench, layout: Layout, bounds: Bounds, *, anywhere: bool) -> None:
        self.bench = bench
        self.layout = layout
        self.bounds = bounds
        self.anywhere = anywhere
        self.identity = bench_identity(bench.identity_hash)  # once: it is a hash of the bench
        """Bench identity that the node's status must report."""

    def not_ready(self, status: StatusFrame | None, sample: SensorSample, now_ns: int) -> str:
        """Reason why the run may not begin at the newest sample, in hand at a monotonic time [ns]; empty if it may."""
        if now_ns - sample.receive_time_ns > OLDEST_SAMPLE_PERIODS * self.bench.timing.sample_time_ns:
            return "its samples are read too late, this computer is too slow"  # or catching up with what had piled up
        if status is not None and status.node_state is NodeState.FAULT:
            return "its status is FAULT"
        return self.mismatch(status) or self.not_at_rest(sample)

    def mismatch(self, status: StatusFrame | None) -> str:
        """Reason why the node is not the one for this run, by its status; empty if it is."""
        if status is None:
            return "it has not sent its status, so nobody knows what it is"
        if status.protocol_version != self.layout.protocol_version:
            return f"it speaks protocol {status.protocol_version}, expected {self.layout.protocol_version}"
        if status.bench_identity != self.identity:
            found, expected = status.bench_identity, self.identity
            return f"it was set up for bench {found:#06x}, expected {expected:#06x}: another bench file"
        return ""

    def not_at_rest(self, sample: SensorSample) -> str:
        """Reason why the run may not begin where the brake is; empty if it may."""
        if sample.node_state is not NodeState.IDLE:
            return f"the node is {sample.node_state.name}, expected IDLE"
        if self.anywhere:
            return self.bounds.outside(sample)
        if self.bounds.is_home(sample):
            return ""
        home = self.bench.shield
        return (
            f"at {sample.angle:.3f} rad and {sample.velocity:.1f} rad/s; home is within {home.home_angle:g} rad and "
            f"{home.home_velocity:g} rad/s"
        )
