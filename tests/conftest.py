"""What most tests share: the shipped bench, its layout, and a loop on the simulated bus."""

from __future__ import annotations

import importlib
import os
import pkgutil
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from emb_bench.config.bench import Bench, load_bench
from emb_bench.sim.transport import SimTransport, SteppedClock, open_sim
from emb_runtime.can.messages import Layout, load_layout
from emb_runtime.config.bench import CEILING_CURRENT
from emb_runtime.config.bench import Bench as RuntimeBench
from emb_runtime.control.actor import Actor
from emb_runtime.control.core import Core
from emb_runtime.control.loop import Loop
from emb_runtime.control.result import Outcome
from emb_runtime.control.setup import Setup
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.log.ring_buffer import EstimateRecord, EventRecord, FrameRecord, Record
from emb_runtime.records import CycleRecord, Frame
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.heartbeat import Heartbeat, Unwatched
from emb_runtime.safety.shield_design import make_law

# The same examples each time: a suite that passed passes again. New ones: --hypothesis-profile=searching.
# How long an example takes says something of the machine, and nothing of the code.
settings.register_profile(
    "searching",
    settings.get_profile("default"),
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    print_blob=True,
)
settings.register_profile("patient", settings.get_profile("searching"), derandomize=True)
settings.load_profile("patient")

# A shell starts what it puts into the background with Ctrl-C ignored, and every child inherits that.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    """For :mod:`tests.golden` and :mod:`tests.compiled.test_same_bits`."""
    parser.addoption("--update-golden", action="store_true", help="write the golden pages and documents anew")
    parser.addoption("--inputs", type=int, default=20_000, help="inputs of each compiled function (default: 20,000)")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Import all of ours where workers share the tests, each time in another way.

    Hypothesis takes some of its examples from the constants in what is imported of ours: they would depend on which
    tests a worker has run before. It takes 5 s, longer than most tests, so that a plain ``pytest FILE`` goes without
    and may draw other examples than the whole suite: ``pytest --numprocesses=1 FILE`` draws the same.
    """
    properties = any(item.get_closest_marker("hypothesis") for item in session.items)
    if properties and "PYTEST_XDIST_WORKER" in os.environ:
        for name in ("emb_runtime", "emb_bench", "emb_train", "emb_export"):
            for module in pkgutil.walk_packages(importlib.import_module(name).__path__, f"{name}."):
                importlib.import_module(module.name)


@pytest.fixture(autouse=True)
def _python_s_own_ctrl_c() -> None:
    """A run in this process has taken Ctrl-C for itself, and kept it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _no_real_time() -> Iterator[None]:
    """A test that left this process with real-time priority would rob all others of a processor."""
    yield
    assert os.sched_getscheduler(0) == os.SCHED_OTHER, "a run in the tests' own process needs --no-rt"


@pytest.fixture(scope="session")
def bench() -> Bench:
    return load_bench()


@pytest.fixture(scope="session")
def layout() -> Layout:
    return load_layout()


@dataclass
class Journal:
    """All that was recorded, in its order."""

    records: list[Record] = field(default_factory=list)

    def push(self, record: Record) -> None:
        self.records.append(record)

    @property
    def frames(self) -> list[Frame]:
        return [record.frame for record in self.records if isinstance(record, FrameRecord)]

    @property
    def cycles(self) -> list[CycleRecord]:
        return [record for record in self.records if isinstance(record, CycleRecord)]

    @property
    def estimates(self) -> list[EstimateRecord]:
        return [record for record in self.records if isinstance(record, EstimateRecord)]

    @property
    def events(self) -> list[EventRecord]:
        return [record for record in self.records if isinstance(record, EventRecord)]

    @property
    def codes(self) -> list[str]:
        return [event.code for event in self.events]


class FunctionActor:
    """An actor made of a function of (angle, velocity, step)."""

    def __init__(self, law: Callable[[float, float, float], float]) -> None:
        self.law = law

    def act(self, angle: float, velocity: float, step: float, estimator: Estimator) -> float:
        return self.law(angle, velocity, step)


def make_loop(
    bench: RuntimeBench,
    actor: Actor,
    steps: int,
    *,
    send: Callable[[Frame], None],
    receive: Callable[[int], Frame | None],
    now_ns: Callable[[], int],
    push: Callable[[Record], object],
    stop_requested: Callable[[], bool] = lambda: False,
    pulse: Heartbeat | None = None,
    overheard: Sequence[Frame] = (),
    **core: Any,
) -> Loop:
    """A loop between an actor and a bus; ``core`` replaces what the core takes."""
    pulse, layout = pulse or Unwatched(), core.get("layout") or load_layout()
    given: dict[str, Any] = {
        "bench": bench,
        "layout": layout,
        "law": make_law(bench)._replace(steps=steps),
        "actor": actor,
        "current_limit": 6.0,
        "guard": Guard(layout, bench, send, pulse, core.get("limit", CEILING_CURRENT)),
    }
    return Loop(Core(Setup(**(given | core))), receive, now_ns, push, stop_requested, pulse, overheard)


@dataclass
class SimRun:
    """A run on the simulated bus, and all that can be looked at afterwards."""

    bench: Bench
    outcome: Outcome
    journal: Journal
    transport: SimTransport
    guard: Guard
    sent: list[Frame]


Simulate = Callable[..., SimRun]


@pytest.fixture(scope="session")
def simulate(bench: Bench) -> Simulate:
    return simulating(bench)


def simulating(bench: Bench) -> Simulate:
    """Runs the loop on ``--iface sim``; ``on_receive`` may change, drop or add what the loop receives.

    ``angle``: where a hand has turned the brake before [rad].
    """

    def run(
        law: Callable[[float, float, float], float] = lambda *_: 6.0,
        *,
        options: str = "",
        angle: float = 0.0,
        on_bench: Bench = bench,
        steps: int | None = None,
        actor: Actor | None = None,
        journal: Journal | None = None,
        on_receive: Callable[[Frame | None, SimTransport, SteppedClock], Frame | None] | None = None,
        on_send: Callable[[Frame], None] | None = None,
        **replaced: Any,
    ) -> SimRun:
        transport, clock = open_sim(options, on_bench)
        transport.node.angle = angle
        journal = journal or Journal()
        sent: list[Frame] = []

        def send(frame: Frame) -> None:
            if on_send is not None:
                on_send(frame)
            sent.append(frame)
            transport.send(frame)

        def receive(deadline_ns: int) -> Frame | None:
            frame = transport.receive(deadline_ns)
            return on_receive(frame, transport, clock) if on_receive is not None else frame

        driven: Any = {"send": send, "receive": receive, "now_ns": clock.now_ns, "push": journal.push} | replaced
        loop = make_loop(on_bench, actor or FunctionActor(law), steps or on_bench.timing.horizon, **driven)
        return SimRun(on_bench, loop.run(), journal, transport, loop.core.guard, sent)

    return run
