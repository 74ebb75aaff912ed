"""The gateway between two buses: a drive on one, its software node on the other."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import NamedTuple

from emb_runtime.can.e2e import COUNTER_MODULUS
from emb_runtime.can.messages import load_layout
from emb_runtime.can.transport import TransmitQueueFullError, Transport
from emb_runtime.config.bench import Bench
from emb_runtime.drives.mapping import Mapping
from emb_runtime.drives.node import INTRUDED, DriveNode
from emb_runtime.drives.phases import Arming, Failed, Off, Ready
from emb_runtime.errors import BusError, SafetyStopError
from emb_runtime.records import Frame
from emb_runtime.system.clock import Clock

MOST_FRAMES = 64  # Frames of one bus that are taken at once: a babbling bus must not hold up the other
LISTEN = 0.05  # Least time for which the drive's bus is observed before it is armed [s]
LONGEST_SILENCE = 5.0  # Longest wait for a drive's samples before it is armed [s]
LINGER = 1.0  # Time for which the node still reports its samples after the drive was let go [s]


class Port(NamedTuple):
    """A way to and from one bus, see :class:`Transport`."""

    send: Callable[[Frame], None]
    receive: Callable[[int], Frame | None]


class Gateway:
    """Passes samples and commands on until it is ended, or the drive is let go.

    Both buses are open, and ``clock`` is theirs. ``wait`` waits at most a time [ns], until something has come.
    """

    def __init__(
        self,
        mapping: Mapping,
        bench: Bench,
        drive_bus: Port | Transport,
        node_bus: Port | Transport,
        clock: Clock,
        wait: Callable[[int], None],
    ) -> None:
        self.node = DriveNode(mapping, bench, load_layout(), drive_bus.send)
        self._drive_bus, self._node_bus, self._clock, self._wait = drive_bus, node_bus, clock, wait
        self._node_lost: BusError | None = None
        steps = (*mapping.arm, *mapping.disarm)
        sent = {mapping.command.message} | {constant.message for step in steps for constant in step.frames}
        received = mapping.sensor_messages | ({mapping.state.message} if mapping.state else set())
        ours, theirs = (
            {(info.extended, info.identifier) for info in map(mapping.messages.__getitem__, names)}
            for names in (sent, received)
        )
        self._commands = ours - theirs  # a drive may answer under the identifier of its command
        self._is_commanded = False  # by another node
        self._layout, self._counter = load_layout(), 0

    def run(self, stop_requested: Callable[[], bool], ready: Callable[[], None], *, arms: bool) -> None:
        """Arm the drive, tell that it is ``ready``, serve, and let the drive go.

        Where it is not to be armed, nothing is sent to it.

        Raises:
            BusError: the drive cannot be armed, or a bus is lost.
            SafetyStopError: the node let the drive go, but not for the operator; the message has the reason.
        """
        try:
            self._serve(stop_requested, ready, arms=arms)
        finally:
            with contextlib.suppress(BusError):  # the drive's bus may be what is lost
                self.node.abandon()

    def _serve(self, stop_requested: Callable[[], bool], ready: Callable[[], None], *, arms: bool) -> None:
        sent = arms and self.arm(stop_requested)
        if not arms or isinstance(self.node.phase, Ready):
            ready()
        ended_ns = None
        while ended_ns is None or self._clock.now_ns() < ended_ns:
            self.serve_once()
            if stop_requested() or self._node_lost is not None:
                self.node.disarm()
                if isinstance(self.node.phase, Off | Failed):
                    break
            elif arms and ended_ns is None and isinstance(self.node.phase, Off | Failed):
                ended_ns = self._after(LINGER)
        problem = self._release_problem() if sent else ""
        failure = self._failure(stopped=not stop_requested())
        if problem:
            raise BusError(f"{failure}; {problem}" if failure else problem)
        if failure is not None:
            raise failure

    def _failure(self, *, stopped: bool) -> BusError | SafetyStopError | None:
        if self._node_lost is not None:
            return self._node_lost
        if self.node.failure:
            return SafetyStopError(f"the drive was disarmed: {self.node.failure}")
        if stopped:
            return SafetyStopError(f"the drive was disarmed after a stop, reason {self.node.stop_reason.name}")
        return None

    def _release_problem(self) -> str:
        """Reason why the drive may still be armed; empty if it reports within a time that it is not."""
        deadline_ns = self._after(LINGER)
        while (problem := self.node.release_problem) and self._clock.now_ns() < deadline_ns:
            try:
                self.serve_once()
            except BusError as err:
                problem = f"{problem}: {err}"
                break
        return problem and f"{problem}; switch it off"

    def arm(self, stop_requested: Callable[[], bool]) -> bool:
        """Arm the drive, or raise BusError; False if the end came first, and nothing was sent."""
        listened_ns, silent_ns = self._after(LISTEN), self._after(LONGEST_SILENCE)
        while not (stop_requested() or self._node_lost):
            if self.node.may_arm and self._clock.now_ns() > listened_ns:
                break
            if self._clock.now_ns() > silent_ns:
                raise BusError(
                    f"no samples of the drive: check that it is on, on this bus, with this DBC{self.node.reported}"
                )
            self.serve_once()
            if self._is_commanded:
                raise BusError(f"cannot arm the drive: {INTRUDED}")
        else:
            return False
        self.node.arm(self._clock.now_ns())
        while isinstance(self.node.phase, Arming):
            self.serve_once()
            if stop_requested():
                self.node.disarm()
        if isinstance(self.node.phase, Failed):
            reported, problem = self.node.reported, self._release_problem()
            raise BusError(f"cannot arm the drive: {self.node.failure}{reported}{problem and f'; {problem}'}")
        return True

    def serve_once(self) -> None:
        """Wait for what comes first, take what has come, and do what is due; BusError if the drive's bus is lost."""
        now_ns = self._clock.now_ns()
        self._wait(self.node.due_ns(now_ns + 1) - now_ns)
        for _ in range(MOST_FRAMES):
            if (frame := self._received()) is None:
                break
            if not (frame.own or frame.error):
                self.node.handle_host(frame, self._clock.now_ns())
        for _ in range(MOST_FRAMES):
            if (frame := self._drive_bus.receive(0)) is None:
                break
            if not (frame.own or frame.error) and (frame.extended, frame.identifier) in self._commands:
                self._intruded()
            for ours in self.node.handle_drive(frame, self._clock.now_ns()):
                self._pass_on(ours)
                if ours.identifier == self._layout.status.identifier:
                    self._pass_on(self._counts())
        self.node.tick(self._clock.now_ns())

    def _intruded(self) -> None:
        """Take note of another commander: the node lets go, and the host hears of one as on a bus that they share."""
        self._is_commanded = True
        if self.node.handle_intrusion():  # a disabled command that the host has not sent
            self._pass_on(self._layout.encode_command(0, 0, 0.0, False))

    def _after(self, seconds: float) -> int:
        """Time so much later than now [ns]."""
        return self._clock.now_ns() + int(seconds * 1e9)

    def _counts(self) -> Frame:
        """The counts for the host's log; they go with each status."""
        node, not_believed = self.node, sum(self.node.receiver.rejected.values())
        self._counter = (self._counter + 1) % COUNTER_MODULUS
        return self._layout.encode_gateway(
            self._counter, node.outlet.not_sent, node.answers.braked, not_believed, node.outlet.guard.rejected
        )

    def _received(self) -> Frame | None:
        try:
            return self._node_bus.receive(0)
        except BusError as err:
            self._node_lost = err
            return None

    def _pass_on(self, frame: Frame) -> None:
        """Put a frame on the node's bus; one for which there is no room is lost, as on any bus."""
        try:
            self._node_bus.send(frame)
        except TransmitQueueFullError:
            pass
        except BusError as err:
            self._node_lost = err
