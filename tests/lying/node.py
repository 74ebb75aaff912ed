"""A brake on the bus whose node lies: pure, for a simulated bus and a real one. Standard library only.

The codec is written from the layout's page, not from the project's code: bytes are put together by hand, the CRC is
computed bit by bit. The brake is that of Table 4.1 of the thesis, stepped finely; what it really does
is kept apart from what is said of it.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

COMMAND, ANGLE, VELOCITY, STATUS = 0x080, 0x100, 0x101, 0x102
DATA_ID = {COMMAND: 57985, ANGLE: 57986, VELOCITY: 57987, STATUS: 57988}
IDLE, ACTIVE, STOPPING = 0, 1, 2
NONE, NEVER, WATCHDOG, DISABLED, LIMIT = 0, 1, 2, 3, 4
NO_COMMAND = 15
PERIOD_NS = 1_000_000
WATCHDOG_PERIODS = 10
STATUS_PERIODS = 100

J, GAMMA, K_M, K_1, T_C, F_V = 4.624e-6, 1.889e-5, 2.170e-2, 2.304e1, 1.037e-2, 2.160e-5
WAVE = 5.0  # Hz
STEPS = 4  # Of the brake's motion in a period: the midpoint rule is as exact with 4 as with 400

Said = tuple[int, bytes]  # Identifier and payload of a frame


@dataclass(frozen=True)
class Lie:
    """What the node says or does wrong, from :attr:`begin` on; all of them may be combined."""

    drift: float = 0.0  # Rate of the said angle beside the true one [rad/s]
    offset: float = 0.0  # Of the said velocity [rad/s]
    scale: float = 1.0  # Of the said angle and velocity
    sensors: int = 1  # -1: angle and velocity are said with the wrong sign
    motor: int = 1  # -1: a positive current drives the brake backwards
    clock: float = 1.0  # Rate of the said device time
    clock_jump: float = 0.0  # The said device time jumps by this once [s]
    clock_jump_angle: float = 0.0  # At that instant the said angle is off by this, for good [rad]
    clock_random: float = 0.0  # Each said device time is off by up to this, later or earlier [s]
    jump: float = 0.0  # The said angle is off by this [rad]
    crc: bool = False  # The velocity frame's CRC is wrong
    deaf: bool = False  # Commands are not obeyed
    current: float = math.nan
    """The said current of a period that the node brakes by itself [A]; such periods come with it."""
    idle: bool = False  # The said state is idle
    identity: int = 0  # Added to the said identity of the bench
    protocol: int = 0  # Added to the said version of the protocol
    twice: bool = False  # Each period has two samples, with the time stamps of two periods
    slide: float = 0.0  # The scale of said velocity and angle falls at this rate [1/s]; the angle stays its integral
    wave: float = 0.0  # That scale swings by this share, WAVE times a second
    step: float = 1.0  # That scale from begin on
    both: float = 0.0  # The said velocity is off by this, and the said angle is its integral [rad/s]
    zero: float = 0.0  # True angle where 0 is said, from the start [rad]
    curve: float = 0.0  # The said angle lacks this times its square, the velocity accordingly [1/rad]
    gain: float = 1.0  # True current over the commanded one
    gain_rate: float = 0.0  # Rate of that ratio [1/s]
    gain_wave: float = 0.0  # That ratio swings by this, WAVE times a second
    offset_current: float = 0.0  # True current beyond the commanded one [A]
    dead: float = 0.0  # Commanded currents up to this do not act, larger ones act less by this [A]
    reported: float = 0.0  # The said current of an obeyed command is off by this [A]
    friction_rate: float = 0.0  # Rate at which Coulomb friction grows, as a share of it [1/s]
    stiffness: float = 1.0  # Stiffness from begin on, as a multiple
    imagined: float = 1.0
    """What is said is no measurement, but a model: the true brake with this many times its k_m."""
    blind: bool = False  # The node's own limits see what is said, not what is true: they never act
    lost: float = 0.0  # Share of the samples, from the start, whose velocity frame has a wrong CRC
    duty: float = 1.0  # Share of the periods in which it lies, evenly spread; an angle that drifts goes on meanwhile
    begin: float = 0.06  # Time from the first obeyed command to the first lie [s]


HONEST = Lie()


def crc(data_id: int, body: bytes) -> int:
    """CRC-8 SAE J1850, without start value and final XOR, over the data id and the bytes after the CRC."""
    register = 0
    for byte in data_id.to_bytes(2, "little") + body:
        register ^= byte
        for _ in range(8):
            register = ((register << 1) ^ 0x1D) & 0xFF if register & 0x80 else register << 1
    return register


def frame(identifier: int, word: int) -> Said:
    """A frame from its payload as one number, little-endian, whose lowest byte is left to the CRC."""
    body = word.to_bytes(8, "little")[1:]
    return identifier, bytes([crc(DATA_ID[identifier], body)]) + body


def raw(value: float, step: float, bits: int) -> int:
    """A physical value as a two's complement number of so many bits; beyond its range it shows the range's end."""
    highest = (1 << (bits - 1)) - 1
    return min(max(round(value / step), -highest), highest) & ((1 << bits) - 1)


class LyingNode:
    """The node.

    Args:
        identity: of the bench for which it is set up: 16 bits.
        lie: what it lies about.
        seed: of the sensors' noise.
    """

    def __init__(self, identity: int, lie: Lie = HONEST, seed: int = 1) -> None:
        self._identity = identity
        self._lie = lie
        self._random = random.Random(seed)
        self.angle, self.velocity = lie.zero, 0.0
        self.lowest = self.highest = lie.zero
        self.fastest = 0.0
        """True angle [rad] and speed [rad/s], lowest, highest, highest."""
        self.state, self.reason = IDLE, NEVER
        self.periods = self.obeyed = self.braked = self.rejected = 0
        self.began: int | None = None
        """Period of the first lie; None if there was none."""
        self.stopped: int | None = None
        """Period in which the stop began, after the first obeyed command."""
        self._model = self.angle, self.velocity  # what the lie's model does
        self._counter = 14
        self._status_counter = 0
        self._taken: tuple[int, float, bool] | None = None
        self._heard = NO_COMMAND  # counter of the last command heard
        self._first: int | None = None
        self._unobeyed = 0
        self._resting = 0
        self._shift = 0.0  # of the said angle [rad]
        self._late = 0.0  # of the said device time [s]
        self._phase = 0.0
        self._turn = False

    @property
    def lying(self) -> bool:
        """True in a period in which it lies."""
        return self._first is not None and self.periods - self._first >= round(self._lie.begin * 1e3) and self._turn

    def receive(self, identifier: int, data: bytes) -> None:
        """Take a frame from the bus."""
        if identifier != COMMAND or len(data) != 5 or crc(DATA_ID[COMMAND], data[1:]) != data[0]:
            return
        counter, answers = data[1] & 0x0F, data[1] >> 4
        current = int.from_bytes(data[2:4], "little", signed=True) * 2e-4
        enable = bool(data[4] & 1)
        if counter == self._heard or (enable and answers != self._counter) or abs(current) > 6.0:
            self.rejected += 1
            return
        self._heard = counter
        if not enable or self.state in (IDLE, ACTIVE):
            self._taken = counter, current, enable

    def tick(self, skipped: int = 0) -> list[Said]:
        """Let a period pass, and more that were slept through; what is sent at its end."""
        for _ in range(skipped):
            self._taken = None
            self._pass()
        applied, obeyed = self._pass()
        self._counter = (self._counter + 1) % 15
        said = self._sample(applied, obeyed)
        if self.lying and self._lie.twice:
            self._counter = (self._counter + 1) % 15
            self._late += 1e-3
            said += self._sample(applied, obeyed)
        if self.periods % STATUS_PERIODS == 1:
            said.append(self._status())
        return said

    def _pass(self) -> tuple[float, int]:
        """One period; the current that acted, and the counter of the command that was obeyed."""
        lie, taken, self._taken = self._lie, self._taken, None
        self._phase += lie.duty
        self._turn = self._phase >= 1.0
        self._phase -= self._turn
        self.periods += 1
        if self.lying:
            if self.began is None:
                self.began = self.periods
                self._late += lie.clock_jump
                self._shift += lie.clock_jump_angle
            if lie.deaf or not math.isnan(lie.current):
                taken = None
            self._late += (lie.clock - 1.0) * 1e-3
        if self.began is not None:
            self._shift += (lie.drift + lie.both) * 1e-3
        current, obeyed = self._act(taken)
        before = self.angle
        self._move(self._felt(current) if obeyed != NO_COMMAND else current)
        self._shift += (self._scale() - 1.0) * (self.angle - before)
        return current, obeyed

    def _since(self) -> float:
        """Time since the first lie [s]; 0 before."""
        return 0.0 if self.began is None else (self.periods - self.began + 1) * 1e-3

    def _scale(self) -> float:
        """Said velocity over the true one."""
        lie, t = self._lie, self._since()
        if self.began is None:
            return 1.0
        return lie.step * max(1.0 - lie.slide * t, 0.05) * (1.0 + lie.wave * math.sin(2.0 * math.pi * WAVE * t))

    def _felt(self, current: float) -> float:
        """The current that acts when this one is commanded."""
        lie, t = self._lie, self._since()
        if self.began is None:
            return current
        gain = lie.gain + lie.gain_rate * t + lie.gain_wave * math.sin(2.0 * math.pi * WAVE * t)
        left = math.copysign(max(abs(current) - lie.dead, 0.0), current)
        return lie.motor * (gain * left + lie.offset_current)

    def _act(self, taken: tuple[int, float, bool] | None) -> tuple[float, int]:
        if taken is not None and taken[2]:
            self.state, self.reason, self._unobeyed = ACTIVE, NONE, 0
            self.obeyed += 1
            if self._first is None:
                self._first = self.periods
            return taken[1], taken[0]
        if self.state == ACTIVE:
            self.braked += 1
            self._unobeyed += 1
            if taken is not None:
                self._stop(DISABLED)
            elif self._unobeyed >= WATCHDOG_PERIODS:
                self._stop(WATCHDOG)
        if self.state == IDLE:
            return 0.0, NO_COMMAND
        seen = self.velocity if self._lie.imagined == 1.0 else self._model[1]
        braking = min(max(-seen / 60.0 * 6.0, -6.0), 6.0)
        return round(braking / 2e-4) * 2e-4, NO_COMMAND

    def _stop(self, reason: int) -> None:
        self.state, self.reason, self._resting = STOPPING, reason, 0
        self.stopped = self.stopped or self.periods

    def _move(self, current: float) -> None:
        stiffness = K_1 if self.began is None else self._lie.stiffness * K_1
        coulomb = T_C * (1.0 + self._lie.friction_rate * self._since())
        self._slide(current, stiffness, coulomb)
        if self._lie.imagined != 1.0:
            true, (self.angle, self.velocity) = (self.angle, self.velocity), self._model
            self._slide(current * self._lie.imagined, K_1, T_C)
            self._model, (self.angle, self.velocity) = (self.angle, self.velocity), true
        self.lowest, self.highest = min(self.lowest, self.angle), max(self.highest, self.angle)
        self.fastest = max(self.fastest, abs(self.velocity))
        if (
            self.state == ACTIVE
            and not self._lie.blind
            and not (-10.0 <= self.angle <= 100.0 and abs(self.velocity) <= 500.0)
        ):
            self._stop(LIMIT)
        if self.state == STOPPING:
            self._resting = self._resting + 1 if abs(self.velocity) < 0.5 else 0
            if self._resting >= 50:
                self.state = IDLE

    def _slide(self, current: float, stiffness: float, coulomb: float) -> None:
        for _ in range(STEPS):
            left = 1e-3 / STEPS
            while left > 0.0:  # Twice where the brake comes to rest within the step
                left -= self._step(left, current, stiffness, coulomb)

    def _step(self, step: float, current: float, stiffness: float, coulomb: float) -> float:
        """Move by the midpoint rule, up to the instant of rest if there is one; the time taken [s]."""

        def drive(angle: float, velocity: float) -> float:
            return K_M * current - GAMMA * stiffness * max(angle, 0.0) - F_V * velocity

        pull = drive(self.angle, self.velocity)
        if self.velocity == 0.0 and abs(pull) <= coulomb:
            return step
        friction = math.copysign(coulomb, self.velocity if self.velocity else pull)
        first = (pull - friction) / J
        half = 0.5 * step
        a = (drive(self.angle + half * self.velocity, self.velocity + half * first) - friction) / J
        after = self.velocity + step * a
        if self.velocity * after < 0.0:
            step, after = -self.velocity / a, 0.0
        self.angle += step * 0.5 * (self.velocity + after)
        self.velocity = after
        return step

    def _sample(self, applied: float, obeyed: int) -> list[Said]:
        lie, time_s = self._lie, self.periods * 1e-3 + self._late
        true_angle, true_velocity = (self.angle, self.velocity) if lie.imagined == 1.0 else self._model
        true = true_angle - lie.zero
        angle = true - lie.curve * true * true + self._random.gauss(0.0, 1e-3)
        velocity = true_velocity * self._scale() * (1.0 - 2.0 * lie.curve * true) + self._random.gauss(0.0, 1.0)
        velocity += 0.0 if self.began is None else lie.both
        state, wrong = self.state, 0
        if self.lying:
            angle, velocity = (lie.sensors * lie.scale * value for value in (angle, velocity))
            velocity += lie.offset
            angle += lie.jump
            time_s += self._random.uniform(-lie.clock_random, lie.clock_random)
            if not math.isnan(lie.current) and obeyed == NO_COMMAND:
                applied = lie.current
            state = IDLE if lie.idle else state
            wrong = 0x40 if lie.crc else 0
        if self.began is not None and obeyed != NO_COMMAND:
            applied += lie.reported
        if self._first is not None and lie.lost and self._random.random() < lie.lost:
            wrong = 0x40
        stamp = round(time_s / 2.5e-7) & 0xFFFFFF
        first = self._counter << 8 | raw(angle + self._shift, 2e-5, 24) << 16 | stamp << 40
        second = self._counter << 8 | state << 12 | raw(velocity, 1e-4, 24) << 16 | raw(applied, 2e-4, 20) << 40
        identifier, data = frame(VELOCITY, second | obeyed << 60)
        return [frame(ANGLE, first), (identifier, bytes([data[0] ^ wrong]) + data[1:])]

    def _status(self) -> Said:
        lie = self._lie if self.lying else HONEST
        identity, protocol = (self._identity + lie.identity) & 0xFFFF, (1 + lie.protocol) & 0xFF
        word = self._status_counter << 8 | self.state << 12 | protocol << 16 | self.reason << 24
        self._status_counter = (self._status_counter + 1) % 15
        return frame(STATUS, word | min(self.rejected, 65535) << 32 | identity << 48)
