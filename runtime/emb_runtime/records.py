"""The records that cross boundaries: small, typed, immutable, SI units."""

from __future__ import annotations

from enum import IntEnum, IntFlag, StrEnum
from typing import NamedTuple


class Frame(NamedTuple):
    """One classical CAN frame as it is on the bus."""

    identifier: int  # 11-bit identifier (29-bit if ``extended``)
    data: bytes  # Payload, at most 8 bytes
    time_ns: int = 0  # Time at which it was on the bus, monotonic clock [ns]; 0 for a frame not sent yet
    extended: bool = False
    remote: bool = False
    error: bool = False
    own: bool = False  # The echo of a frame that this process sent
    dropped: int = 0  # Frames that the kernel has dropped on this socket so far, for want of buffer


class NodeState(IntEnum):
    """State of the node, as it reports it. Values are those of the DBC."""

    IDLE = 0  # No current; waits for an enabled command
    ACTIVE = 1  # Obeys commands
    STOPPING = 2  # Its safe stop has latched; it ignores commands until the brake rests
    FAULT = 3  # It protects itself and does not obey


class SensorSample(NamedTuple):
    """An angle and a velocity frame of one sampling instant, paired by their counter."""

    counter: int  # Alive counter of the pair, 0..14
    angle: float  # Measured angle [rad]
    velocity: float  # Measured (observer) velocity [rad/s]
    device_time_ns: int  # The node's time of the sampling instant, unwrapped [ns]
    receive_time_ns: int  # Monotonic arrival time of the later frame of the two [ns]
    applied_current: float  # Current that the node applied in the period ending at this sample [A]
    command_counter: int  # Counter of the command that the node obeyed in that period; 15 if it obeyed none
    node_state: NodeState


class CurrentCommand(NamedTuple):
    """Command of the runtime to the node, for the period that begins at the sample it answers."""

    counter: int  # Alive counter of the command, 0..14
    answers: int
    """Counter of the sensor sample that it answers, 0..14: the node obeys an answer to its newest sample only."""
    current: float  # [A]
    enable: bool


class RunState(IntEnum):
    """States of a run, in the order in which they are passed; the numbers are those of the logs."""

    INIT = 0
    SILENT = 1  # Listens; nothing leaves
    ARMED = 2  # All checks passed; the next sample begins the experiment
    ACTIVE = 3
    STOPPING = 4  # Sends stop frames
    OVER = 5
    HOMING = 6  # Stands in place of ACTIVE where the brake is brought back to the origin


class Call(IntEnum):
    """Calls of a run's core by its driver, but those that take frames; the numbers are those of the logs."""

    BEGIN = 0  # Listen for the node
    TIMEOUT = 1  # No frame came until the deadline
    ANSWER = 2  # Decide on the frame that answers a sample; then it is sent, or lost
    LATCH = 3  # Latch a fault of the driver
    EXPLAIN = 4  # Record this fault
    STOP_FRAME = 5  # Make a stop frame
    NOTE = 6  # Record an event of the driver
    END = 7  # Check how the node came to rest


class RunType(StrEnum):
    """Type of a run, as in the log's metadata under ``purpose``."""

    EXPERIMENT = "experiment"
    HOMING = "homing"  # To bring the brake to the origin
    LISTEN_ONLY = "reading"  # To see what is on the bus


HOMING_LOG = "-home"
LISTEN_ONLY_LOG = "-read"  # Endings, before the suffix, of the names of logs that hold no experiment


class Reason(IntFlag):
    """Reasons why the sent current differs from the policy's. Bits of ``CycleRecord.reasons``."""

    NONE = 0
    CLIPPED = 1  # Beyond the bench's current limit
    LIMITED = 2  # The envelope shield kept the brake inside its limits
    RETURNING = 4  # The shield took over to be home in time
    MISSED = 8  # Nothing was sent: no sensor pair came in time, or no current may be commanded now
    LEFT = 16  # The current to be sent lies beyond what may be sent (slew, ``--limit``): none was, and the node braked


class CycleRecord(NamedTuple):
    """One control cycle: measured, requested and sent values, the reasons for differences, and the time of each step.

    Times are monotonic nanoseconds. A value that does not exist in a cycle (a policy output in a missed one) is NaN.

    The log's topic ``/cycle`` has these fields, see ``emb.proto``; ``control.memory.Memory.record`` fills them.
    """

    step: int  # Sample index since the experiment began; −1 before
    state: int  # :class:`RunState`
    reasons: int  # :class:`Reason` bits
    counter: int  # Alive counter of the sensor pair; 15 if none came
    command_counter: int  # Alive counter of the command that answered; 15 if none did
    missed: int  # Sampling periods without a valid pair just before this one
    node_state: int  # :class:`NodeState`
    angle: float
    velocity: float
    applied_current: float
    policy_current: float  # Raw output of the policy [A]
    clipped_current: float  # After the finite check and the clip [A]
    sent_current: float  # After the shield: what the guard let out [A]
    device_time_ns: int  # The node's time of the sample
    receive_time_ns: int  # Arrival of the later frame of the pair
    wake_time_ns: int  # Time at which the loop had the frames of the read that completed the pair
    decide_time_ns: int  # Time at which policy, clip and shield had answered and the frame was ready; 0 if it never was
    send_time_ns: int  # Time at which the command had been handed to the bus; 0 if none was

    @property
    def time_ns(self) -> int:
        """Time of its record in the log, as all records have one: the arrival of the pair."""
        return self.receive_time_ns
