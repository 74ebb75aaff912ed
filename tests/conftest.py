"""What most tests share: the shipped bench, its layout, and a loop on the simulated bus."""

from __future__ import annotations

import importlib
import os
import pkgutil
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from emb_bench.sim.transport import SimTransport, open_sim
from emb_runtime.can.messages import Layout, load_layout
from emb_runtime.config.bench import CEILING_CURRENT, Bench, load_bench
from emb_runtime.control.loop import Loop
from emb_runtime.control.result import Outcome
from emb_runtime.records import CycleRecord, Frame
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.heartbeat import Unwatched
from emb_runtime.safety.shield_design import make_law
from emb_runtime.system.clock import SteppedClock

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

FIXTURE_KEPT = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
"""For ``suppress_health_check``, where all examples share what a fixture made: it replaces the profile's."""

# A shell starts what it puts into the background with Ctrl-C ignored, and every child inherits that.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    """For :mod:`tests.golden.test_golden`."""
    parser.addoption("--update-golden", action="store_true", help="write the golden pages anew")


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
class MemoryJournal:
    """A journal that keeps everything."""

    frames: list[Frame] = field(default_factory=list)
    cycles: list[CycleRecord] = field(default_factory=list)
    estimates: list[tuple[int, int, tuple[float, ...]]] = field(default_factory=list)
    learnt: list[tuple[int, int, tuple[float, ...]]] = field(default_factory=list)
    events: list[tuple[int, str, str]] = field(default_factory=list)
    lines: list[tuple[int, int, str]] = field(default_factory=list)

    def push_frame(self, frame: Frame) -> None:
        self.frames.append(frame)

    def push_cycle(self, record: CycleRecord) -> None:
        self.cycles.append(record)

    def push_learnt(self, time_ns: int, step: int, numbers: tuple[float, ...]) -> None:
        self.learnt.append((time_ns, step, numbers))

    def push_estimate(self, time_ns: int, step: int, estimate: tuple[float, ...]) -> None:
        self.estimates.append((time_ns, step, estimate))

    def push_event(self, time_ns: int, code: str, text: str) -> None:
        self.events.append((time_ns, code, text))

    def push_log(self, time_ns: int, level: int, text: str) -> None:
        self.lines.append((time_ns, level, text))

    @property
    def codes(self) -> list[str]:
        return [code for _, code, _ in self.events]


class FunctionActor:
    """An actor made of a function of (angle, velocity, step)."""

    def begin(self) -> None:
        pass

    def __init__(self, law: Callable[[float, float, float], float]) -> None:
        self.law = law

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        return self.law(angle, velocity, step)


@dataclass
class SimRun:
    """A run on the simulated bus, and all that can be looked at afterwards."""

    outcome: Outcome
    journal: MemoryJournal
    transport: SimTransport
    guard: Guard
    sent: list[Frame]


Simulate = Callable[..., SimRun]


@pytest.fixture(scope="session")
def simulate(bench: Bench, layout: Layout) -> Simulate:
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
        current_limit: float = 6.0,
        on_receive: Callable[[Frame | None, SimTransport, SteppedClock], Frame | None] | None = None,
        on_send: Callable[[Frame], None] | None = None,
        stop_requested: Callable[[], bool] = lambda: False,
        **replaced: Any,
    ) -> SimRun:
        transport, clock = open_sim(options, on_bench)
        transport.node.angle = angle
        journal = MemoryJournal()
        sent: list[Frame] = []

        def send(frame: Frame) -> None:
            if on_send is not None:
                on_send(frame)
            sent.append(frame)
            transport.send(frame)

        def receive(deadline_ns: int) -> Frame | None:
            frame = transport.receive(deadline_ns)
            return on_receive(frame, transport, clock) if on_receive is not None else frame

        pulse, limit = replaced.get("pulse", Unwatched()), replaced.get("limit", CEILING_CURRENT)
        guard = Guard(layout, on_bench, send, pulse, limit)
        wanted = steps if steps is not None else on_bench.timing.horizon
        arguments: dict[str, Any] = {
            "bench": on_bench,
            "layout": layout,
            "law": make_law(on_bench)._replace(steps=wanted),
            "actor": FunctionActor(law),
            "current_limit": current_limit,
            "steps": wanted,
            "guard": guard,
            "receive": receive,
            "clock": clock,
            "journal": journal,
            "stop_requested": stop_requested,
        }
        outcome = Loop(**(arguments | replaced)).run()
        return SimRun(outcome, journal, transport, guard, sent)

    return run
