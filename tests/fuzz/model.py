"""What the reception should make of frames, told plainly and anew."""

from __future__ import annotations

from dataclasses import dataclass, field

from emb_runtime.config.bench import Bench
from emb_runtime.records import Frame, NodeState, SensorSample
from tests.independent import Values, read

COMMAND, ANGLE, VELOCITY, STATUS = 0x080, 0x100, 0x101, 0x102
MS = 1_000_000
WRAP_NS = 2**24 * 250
PERMITS_NS = {ANGLE: 2 * MS, VELOCITY: 2 * MS, STATUS: 200 * MS}


@dataclass
class ReceptionModel:
    """Keeps what may be known of the node."""

    bench: Bench
    counters: dict[int, int] = field(default_factory=dict)  # Of the last accepted frame of each message
    errors: dict[int, int] = field(default_factory=lambda: dict.fromkeys((ANGLE, VELOCITY, STATUS, 0), 0))
    """Leaky counts; 0 stands for the pairs."""
    valid_ns: dict[int, int] = field(default_factory=dict)  # Arrival of the last accepted frame of each message
    rejected: int = 0
    foreign: bool = False
    too_many: bool = False
    last: SensorSample | None = None
    _waiting: tuple[Values, int] | None = None
    _device: tuple[int, int] | None = None  # Device time and arrival of the last pair

    def take(self, frame: Frame) -> SensorSample | None:
        """What a frame adds."""
        if frame.error or frame.own or frame.extended:
            return None
        if frame.identifier == COMMAND:
            self.foreign = True
        if frame.identifier not in PERMITS_NS:
            return None
        values = read(frame)
        if values is None or self.counters.get(frame.identifier) == values["Counter"]:
            self._bad(frame.identifier)
            return None
        self.counters[frame.identifier] = int(values["Counter"])
        self.valid_ns[frame.identifier] = frame.time_ns
        self._good(frame.identifier)
        if frame.identifier == ANGLE:
            self._waiting = values, frame.time_ns
        return self._complete(values, frame.time_ns) if frame.identifier == VELOCITY else None

    def permitted(self, now_ns: int) -> bool:
        """Whether a current may be commanded."""
        if self.foreign or self.too_many or self.last is None:
            return False
        ages = [(now_ns - self.last.receive_time_ns, 2 * MS)]
        for identifier, longest in PERMITS_NS.items():
            if identifier not in self.valid_ns:
                return False
            ages.append((now_ns - self.valid_ns[identifier], longest))
        return all(-1 * MS <= age <= longest for age, longest in ages)

    def _complete(self, velocity: Values, now_ns: int) -> SensorSample | None:
        if self._waiting is None:
            return None
        angle, then_ns = self._waiting
        if angle["Counter"] != velocity["Counter"] or abs(now_ns - then_ns) > 2 * MS:
            return None
        self._waiting = None
        sample = SensorSample(
            counter=int(angle["Counter"]),
            angle=angle["Angle"],
            velocity=velocity["Velocity"],
            device_time_ns=self._unwrapped(round(angle["DeviceTime"] * 1e9), then_ns),
            receive_time_ns=max(now_ns, then_ns),
            applied_current=velocity["AppliedCurrent"],
            command_counter=int(velocity["CommandCounter"]),
            node_state=NodeState(int(velocity["NodeState"])),
        )
        if self.last is not None and not self._follows(self.last, sample):
            self._bad(0)
            return None
        self._good(0)
        self.last = sample
        return sample

    def _unwrapped(self, stamp_ns: int, arrival_ns: int) -> int:
        """The time with that stamp that lies nearest to where the arrivals say that the device's clock stands."""
        if self._device is None:
            device_ns = stamp_ns
        else:
            expected = self._device[0] + arrival_ns - self._device[1]
            wraps = (expected - stamp_ns) // WRAP_NS
            candidates = [stamp_ns + (wraps + n) * WRAP_NS for n in (-1, 0, 1, 2)]
            device_ns = min(candidates, key=lambda c: (abs(c - expected), c))
        self._device = device_ns, arrival_ns
        return device_ns

    def _follows(self, last: SensorSample, sample: SensorSample) -> bool:
        elapsed = (sample.device_time_ns - last.device_time_ns) * 1e-9
        if elapsed < 0.5e-3:
            return False
        bench = self.bench
        worst = bench.range_set(bench.shield.ranges)
        force = (
            worst.high.k_m * bench.limits.current
            + worst.high.gamma * worst.high.k_1 * max(abs(limit) for limit in bench.limits.angle)
            + worst.high.T_c
            + worst.high.f_v * bench.limits.velocity
        )
        acceleration = force / worst.low.J
        observer = bench.sensors.bandwidth
        late = acceleration * 2.25 / min(observer, 3000.0) if observer else 0.0  # one sampled each 1 ms, by L13
        noise = bench.shield.noise_sigmas * (1.5 * bench.noise.angle + elapsed * bench.noise.velocity)
        mean = (last.velocity + sample.velocity) / 2
        return abs(sample.angle - last.angle - mean * elapsed) <= noise + elapsed * late + acceleration * elapsed**2 / 2

    def _bad(self, which: int) -> None:
        self.rejected += 1
        self.errors[which] = min(self.errors[which] + 4, 4 * self.bench.watch.rejected)
        if self.errors[which] == 4 * self.bench.watch.rejected:
            self.too_many = True

    def _good(self, which: int) -> None:
        self.errors[which] = max(self.errors[which] - 1, 0)
