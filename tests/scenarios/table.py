"""Faults, and what may come of each: one table, played wherever a row says how.

In the simulated loop (``tests/runtime/control/test_faults.py``), from the record of that run again
(``tests/bench/test_rerun.py``), and against emb-run and emb-node as shipped on a real bus (``tests/hil``). What a node
may lie about is in :mod:`tests.scenarios.lies`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.errors import BusError
from emb_runtime.records import NodeState
from emb_runtime.safety.state_machine import FAULTS, Fault
from tests.conftest import SimRun, Simulate
from tests.drives import SHIPPED
from tests.scenarios import injections as by
from tests.scenarios.injections import ANGLE, COMMAND, STATUS, VELOCITY, Pulse

Action = dict[str, Any]  # Done in the kernel by the method of tests.hil.stage that ``do`` names
KILLED = -9


@dataclass(frozen=True)
class Scenario:
    """One fault, and what may come of it."""

    name: str
    what: str  # In words
    results: tuple[str, ...]  # What a run may say: ``done`` or a fault; empty if it is killed
    loop: Callable[[Simulate], SimRun] | None = None
    """A run of the simulated loop with it, if there is one; it says the first of the results."""
    # On a bus:
    actions: tuple[Action, ...] | None = None  # None: it is not played there
    before: tuple[Action, ...] = ()  # Done before anything is started
    node_bus: str = "vcan0"
    run_bus: str = "vcan0"
    log: str = ""  # Where the log goes, if not into the ordinary memory
    linger: float = 0.8  # How long the bus is watched after the run's end [s]
    node_lost: bool = False  # The fault takes the node away, so its stop cannot be seen
    may_lose: int = 0
    """Frames that the log may lack: what the loop had in hand when it was killed, or what a killed recorder had."""
    stops: bool = True  # The fault must end in the node's safe stop before the experiment's own end
    stop_frames: int | None = 3  # Last commands on the bus, all disabled; None if some may be lost or are a stranger's
    policy: str = ""  # How it fails: "giant" asks for too much, others are of :mod:`tests.hil.failing_policy`
    drive: str = ""  # Simulated drive in place of the node, behind its mapping
    options: tuple[str, ...] = ()  # Further ones of emb-run

    @property
    def exits(self) -> tuple[int, ...]:
        """Exit codes of emb-run that go with the results."""
        codes = {"done": 0, "LOG_INCOMPLETE": 6} | {fault.name: info.exit_code for fault, info in FAULTS.items()}
        return tuple(sorted({codes[result] for result in self.results})) or (KILLED,)

    @property
    def fault(self) -> Fault | None:
        """The fault that the loop's run is about; None where it ends as if there had been none."""
        return None if self.results[0] == "done" else Fault[self.results[0]]


def _signal(to: str, name: str, after: int = 0, pause: float = 0.0, stops: int = 0) -> Action:
    """Waits for commands, then for stop frames, then for a time, and signals."""
    return {"do": "signal", "to": to, "signal": name, "after": after, "pause": pause, "stops": stops}


def _impair(after: int, **by: float) -> Action:
    return {"do": "impair", "interface": "vcan0", "by": by, "after": after}


def _corrupt(identifier: int) -> Action:
    return {"do": "corrupt", "identifier": identifier, "xor": "0000010000000000", "after": WHEN}


def _link(interface: str, up: bool, **when: float) -> Action:
    return {"do": "link", "interface": interface, "up": up, **when}


def _babble(identifier: int) -> Action:
    return {"do": "babble", "identifier": identifier, "data": "ff" * 8, "seconds": 0.05, "after": WHEN}


def _kill(*roles: str, after: int) -> Action:
    return {"do": "kill", "roles": roles, "after": after}


def _mapped(name: str, what: str, drive: str, results: tuple[str, ...], *actions: Action, **more: Any) -> Scenario:
    return Scenario(
        f"mapped_{name}", what, results, actions=actions, drive=drive, stops=False, stop_frames=None,
        may_lose=10**6, run_bus="vcan1", **more,
    )  # fmt: skip


WHEN = 150  # Commands after which a fault strikes: the brake is fast and far out
LATE = 400  # The same, for what needs some of the log to be on disk
IN_HAND = 3  # Frames that wait for the next record
HALF_A_SECOND = 2000  # Frames of a bus of four per period
JOINED = ({"do": "corrupt", "identifier": VELOCITY},)
STOPPED = ("NODE_STOPPED", "NOT_OBEYED", "SENSOR_LOST")
# Too many for an experiment, and within half a second not yet too many for the node to be lost.
MISSING_21_PERCENT = [n for n in range(20, 10_000) if 21 * n % 100 < 21]

SCENARIOS = (
    # Where the simulated loop and the programs on a bus meet the same.
    Scenario("normal", "nothing", ("done",), lambda run: run(), (), stops=False),
    Scenario(
        "interrupted", "Ctrl-C", ("INTERRUPTED",), lambda run: run(stop_requested=by.asked_often(700)),
        (_signal("run", "SIGINT", WHEN),),
    ),
    Scenario(
        "loop_stopped", "the loop stands still for 0.3 s, longer than its watchdog waits", ("WATCHDOG_TRIPPED",),
        lambda run: run(pulse=Pulse(trips_at=1500)),
        (_signal("run", "SIGSTOP", WHEN), _signal("run", "SIGCONT", pause=0.3)),
    ),
    Scenario(
        "watchdog_killed", "the watchdog ends", ("WATCHDOG_LOST",), lambda run: run(pulse=Pulse(silent_at=150)),
        (_signal("watchdog", "SIGKILL", WHEN),),
    ),
    Scenario(
        "corrupted_sensor", "every velocity frame is damaged", ("FRAMES_REJECTED",),
        lambda run: run(on_receive=by.changing(by.shortened, VELOCITY, range(100, 110))),
        (_corrupt(VELOCITY),), JOINED, "vcan1",
    ),
    Scenario(
        "foreign_commander", "somebody else commands", ("FOREIGN_COMMAND",), lambda run: run(on_receive=by.intruding()),
        ({"do": "command", "after": WHEN},), stop_frames=None,
    ),
    Scenario(
        "link_down", "the interface is down", ("BUS_LOST",), lambda run: run(on_send=by.failing(BusError, 99)),
        (_link("vcan0", up=False, after=WHEN), _link("vcan0", up=True, pause=0.05)), node_lost=True, stop_frames=None,
    ),
    Scenario(
        "giant", "a policy gone mad", ("POLICY_BEYOND_CONTRACT",),
        lambda run: run(lambda _a, _v, k: 1e9 if k == 120 else 4.0), (), policy="giant", stops=False,
    ),
    # In the simulated loop: one for each other fault.
    Scenario("no_node", "nothing is heard", ("NO_NODE",), lambda run: run(on_receive=by.nothing)),
    Scenario(
        "moved_before", "the brake is not in its origin", ("NODE_NOT_READY",),
        lambda run: run(on_receive=by.moved_unseen(by.away)),
    ),
    Scenario(
        "angle_lost", "no angle comes any more", ("SENSOR_LOST",),
        lambda run: run(on_receive=by.dropping(ANGLE, range(100, 10_000))),
    ),
    Scenario(
        "turned_out", "a hand turns the brake out of its limits as the way home begins", ("OUT_OF_LIMITS",),
        lambda run: run(homing=True, angle=-9.95, on_receive=by.turned_out),
    ),
    Scenario(
        "drift", "the angle drifts beside the velocity", ("SENSORS_CONTRADICT",), lambda run: run(on_receive=by.drift),
    ),
    Scenario(
        "another_brake", "a brake outside the set", ("MOTION_OUTSIDE_SET",),
        lambda run: run(options="k_m=0.06,f_v=1e-6,T_c=2e-4"),
    ),
    Scenario(
        "polarity", "both sensors have the wrong sign", ("WRONG_POLARITY",),
        lambda run: run(on_receive=by.changing(by.saying(Angle=lambda x: -x, Velocity=lambda v: -v))),
    ),
    Scenario(
        "node_stops", "the node stops by itself", ("NODE_STOPPED",),
        lambda run: run(on_receive=by.at_period(200, by.stop)),
    ),
    Scenario("deaf", "the node hears nothing", ("NOT_OBEYED",), lambda run: run(on_receive=by.deafen)),
    Scenario(
        "not_a_number", "the policy answers no number", ("POLICY_NOT_FINITE",),
        lambda run: run(lambda _a, _v, k: math.nan if k == 120 else 4.0),
    ),
    Scenario("unguarded", "an error before the guard", ("GUARD_REJECTED",), by.an_error_before_the_guard),
    Scenario("program", "an error of the program", ("INTERNAL",), lambda run: run(lambda _a, _v, k: 1.0 / (k - 150.0))),
    Scenario(
        "current", "the drive reports another current", ("CURRENT_MISMATCH",),
        lambda run: run(lambda *_: 3.0, on_receive=by.later(VELOCITY, 200, AppliedCurrent=0.5)),
    ),
    Scenario(
        "not_home", "the way home is too long for its time", ("NOT_HOME",),
        lambda run: run(lambda *_: 0.0, homing=True, steps=30, angle=40.0),
    ),
    Scenario(
        "clock_jumps", "the node's clock jumps", ("DEVICE_TIME",),
        lambda run: run(on_receive=by.later(ANGLE, 200, DeviceTime=lambda time: time + 0.5)),
    ),
    Scenario(
        "incomplete", "a fifth of the angles is lost", ("INCOMPLETE",),
        lambda run: run(on_receive=by.dropping(ANGLE, MISSING_21_PERCENT)),
    ),
    Scenario(
        "exchanged", "the node is for another bench", ("NODE_CHANGED",),
        lambda run: run(on_receive=by.later(STATUS, 200, BenchIdentity=lambda number: int(number) ^ 1)),
    ),
    Scenario(
        "unexplained", "a current that no brake explains", ("MOTION_UNEXPLAINED",),
        lambda run: run(
            lambda _x, _v, step: 6.0 if step // 60 % 2 == 0 else -6.0,
            on_receive=by.later(VELOCITY, 0, AppliedCurrent=lambda current: current + 0.4),
        ),
    ),
    Scenario("lag", "an undeclared lag", ("RESPONSE_LATE",), lambda run: run(options="plant=lag")),
    Scenario(
        "restless", "the node does not come to rest", ("NOT_AT_REST",),
        lambda run: run(on_receive=by.later(VELOCITY, 520, NodeState=NodeState.FAULT)),
    ),
    Scenario(
        "velocities_lost", "six velocities are lost", ("SENSOR_LATE",),
        lambda run: run(on_receive=by.dropping(VELOCITY, range(100, 106))),
    ),
    Scenario(
        "queue", "three commands find no room", ("SEND_QUEUE_FULL",),
        lambda run: run(on_send=by.failing(TransmitQueueFullError, 100, 200, 201)),
    ),
    Scenario(
        "dropped", "the kernel drops frames", ("FRAMES_DROPPED",),
        lambda run: run(on_receive=by.changing(lambda frame: frame._replace(dropped=7), periods=range(200, 10_000))),
    ),
    Scenario(
        "errors", "the controller reports errors", ("BUS_ERRORS",),
        lambda run: run(on_receive=by.changing(by.reported, VELOCITY, range(200, 203))),
    ),
    Scenario(
        "no_status", "two status messages are lost", ("PERMISSION_LOST",),
        lambda run: run(on_receive=by.dropping(STATUS, range(100, 300))),
    ),
    # On a bus: processes, the kernel, the host.
    Scenario("loop_killed", "kill -9 of the loop", (), None, (_signal("run", "SIGKILL", WHEN),), may_lose=IN_HAND),
    Scenario(
        "loop_and_watchdog_killed", "kill -9 of loop and watchdog", (), None, (_kill("watchdog", "run", after=WHEN),),
        may_lose=IN_HAND, stop_frames=0,
    ),
    Scenario(
        "loop_and_recorder_killed", "kill -9 of loop and recorder", (), None,
        (_signal("recorder", "SIGKILL", LATE), _signal("run", "SIGKILL")), may_lose=HALF_A_SECOND,
    ),
    Scenario(
        "recorder_killed", "kill -9 of the recorder", ("LOG_INCOMPLETE",), None,
        (_signal("recorder", "SIGKILL", LATE),), stops=False, may_lose=HALF_A_SECOND,
    ),
    Scenario(
        "recorder_stopped", "SIGSTOP of the recorder for 0.2 s", ("done",), None,
        (_signal("recorder", "SIGSTOP", WHEN), _signal("recorder", "SIGCONT", pause=0.2)), stops=False,
    ),
    Scenario(
        "watchdog_stopped", "SIGSTOP of the watchdog", ("WATCHDOG_LOST",), None,
        (_signal("watchdog", "SIGSTOP", WHEN), _signal("watchdog", "SIGCONT", pause=0.3)),
    ),
    Scenario(
        "node_killed", "kill -9 of the node, which then returns", ("SENSOR_LOST",), None,
        (_signal("node", "SIGKILL", WHEN), {"do": "restart_node", "pause": 0.2}), node_lost=True,
    ),
    Scenario(
        "node_stopped", "SIGSTOP of the node for 0.2 s", ("SENSOR_LOST", "NODE_STOPPED"), None,
        (_signal("node", "SIGSTOP", WHEN), _signal("node", "SIGCONT", pause=0.2)), node_lost=True,
    ),
    Scenario(
        "loss", "5 % of all frames lost", ("done",), None, (_impair(50, loss=0.05),), stops=False, stop_frames=None,
    ),
    Scenario(
        "silence", "all frames lost for 50 ms", STOPPED, None,
        (_impair(WHEN, loss=1.0), {"do": "clear_netem", "interface": "vcan0", "pause": 0.05}),
        node_lost=True, stop_frames=None,
    ),
    Scenario("delay", "all frames delayed by 0.1 ms", ("done",), None, (_impair(WHEN, delay=0.0001),), stops=False),
    Scenario("late", "all frames delayed by 2 ms", STOPPED, None, (_impair(WHEN, delay=0.002),)),
    Scenario(
        "duplicates", "10 % of all frames twice", ("done", "FRAMES_REJECTED", "FOREIGN_COMMAND"), None,
        (_impair(WHEN, duplicate=0.1),), stops=False, stop_frames=None,
    ),
    Scenario(
        "reordered", "every fourth frame overtakes", ("done", "FRAMES_REJECTED", *STOPPED), None,
        (_impair(WHEN, delay=0.0003, reorder=0.25),), stops=False, stop_frames=None,
    ),
    Scenario(
        "corrupted_command", "a bit of every command turned over", STOPPED, None, (_corrupt(COMMAND),), JOINED, "vcan1",
    ),
    Scenario(
        "babbling_stranger", "a stranger sends without a pause for 50 ms", ("done",), None, (_babble(0x7FF),),
        stops=False,
    ),
    Scenario(
        "babbling_impostor", "false velocity frames without a pause for 50 ms", ("FRAMES_REJECTED",), None,
        (_babble(VELOCITY),),
    ),
    Scenario(
        "no_room", "frames wait 5 ms on their way out, two at most", STOPPED, None,
        (_impair(WHEN, delay=0.005, limit=2),), node_lost=True, stop_frames=None,
    ),
    Scenario(
        "bus_off", "the controller goes bus-off", ("BUS_LOST",), None, ({"do": "bus_off", "off": True, "after": WHEN},),
    ),
    Scenario(
        "disk_full", "the disk fills up in mid-run", ("LOG_INCOMPLETE",), None,
        ({"do": "fill", "where": "/run/small", "after": WHEN},),
        before=({"do": "small_disk", "where": "/run/small", "size": 16 << 20},), log="/run/small/disk_full.mcap",
        stops=False,
    ),
    *(
        Scenario(
            name, f"the time of day steps by {step:+.0f} s", ("done",), None,
            ({"do": "step_clock", "seconds": step, "after": WHEN},), stops=False,
        )
        for name, step in (("clock_forward", 10.0), ("clock_back", -10.0))
    ),
    Scenario(
        "loop_hung", "the policy does not come back, then kill -9", (), None,
        (_signal("run", "SIGKILL", WHEN, stops=3, pause=0.3),), may_lose=IN_HAND, policy="hung",
    ),
    Scenario(
        "loop_robbed", "another thread of the loop keeps Python's lock, then kill -9", (), None,
        (_signal("run", "SIGKILL", WHEN, stops=3),), may_lose=IN_HAND, policy="robbed of the lock",
    ),
    *(_mapped(drive, "nothing", drive, ("done",)) for drive in SHIPPED),
    _mapped("zero", "nothing, with --zero", "odrive", ("done",), options=("--zero",)),
    *(
        _mapped(
            f"{drive}_host", "kill -9 of all processes of the run", drive, (),
            _kill("gateway", "watchdog", "recorder", "run", after=60),
        )
        for drive in SHIPPED
    ),
    _mapped(
        "left", "kill -9 of run, watchdog and recorder, not of the gateway", "odrive", (),
        _kill("watchdog", "recorder", "run", after=60), linger=2.5,
    ),
    _mapped(
        "gateway", "kill -9 of the gateway", "odrive", ("SENSOR_LOST",), _signal("gateway", "SIGKILL", 60), linger=0.5,
    ),
    _mapped(
        "down", "the drive's interface down", "odrive", ("SENSOR_LOST",), _link("vcan0", up=False, after=60),
        linger=0.5,
    ),
)  # fmt: skip

IN_LOOP = {scenario.name: scenario for scenario in SCENARIOS if scenario.loop is not None}
ON_BUS = {scenario.name: scenario for scenario in SCENARIOS if scenario.actions is not None}


def loop_run(name: str, simulate: Simulate) -> SimRun:
    """The simulated loop's run of a scenario."""
    play = IN_LOOP[name].loop
    assert play is not None
    return play(simulate)
