"""Every fault of tests/hil/faults.py, against the programs as shipped, in time that is hardly this computer's.

Nearly all are played in User-Mode Linux, 1000 times slower than this computer. Where it matters that a processor needs
time, or a queue stands before a controller, it is QEMU's virtual time. Apart from the other tests, because both kernels
keep a processor busy for minutes: ``make test-virtual``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from emb_bench.cli.replay import main as replay
from emb_runtime.config.bench import load_bench

from tests.hil.faults import NETWORK, PLAYS, Play, Seen, Verdict, judge, perform, seen  # isort: skip

SHIPPED = "qemu-shipped"
"""The shipped actor, whose estimator takes too long in Python on QEMU's processor: with the compiled core."""
KERNELS = {"uml": ("--uml", "--slow", "1000"), "qemu": ("--qemu",), SHIPPED: ("--qemu",)}
"""How emb-hil is told to take each."""
ON_A_BUSY_PROCESSOR = ("normal", "delay", "watchdog_killed", "node_killed", "babbling_stranger", "babbling_impostor")
"""Played in QEMU as well: there the programs need nine tenths of the one processor."""
WITH_TIME = {
    "watchdog_killed": "WATCHDOG_LOST",
    "node_killed": "SENSOR_LOST",
    "babbling_stranger": "done",
    "babbling_impostor": "FRAMES_REJECTED",
}
"""What emb-run says of those where the processor is not busy, and nothing else."""
BETWEEN_CONTROLLERS = ("no_room",)  # Played in QEMU only
PLAYED = {
    "uml": tuple(play for play in PLAYS if play.name not in BETWEEN_CONTROLLERS),
    "qemu": tuple(play for play in PLAYS if play.name in (*ON_A_BUSY_PROCESSOR, *BETWEEN_CONTROLLERS)),
    SHIPPED: tuple(play for play in PLAYS if play.name == "normal"),
}
CASES = [pytest.param(kernel, play, id=f"{kernel}-{play.name}") for kernel, plays in PLAYED.items() for play in plays]
NORMAL, KILLED = (next(play for play in PLAYS if play.name == name) for name in ("normal", "loop_killed"))
pytestmark = pytest.mark.timeout(3200)  # far beyond what a busy computer needs

Played = Callable[[str, Play], tuple[Seen, Verdict]]


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    """All of them, played once, in both kernels at a time."""
    folder: Path = tmp_path_factory.mktemp("faults")

    def boot(kernel: str) -> None:
        emb_hil = [sys.executable, "-m", "emb_bench.hil.cli", *KERNELS[kernel], "--root", "--timeout", "3000", "--"]
        emb_hil += ["env", "EMB_CORE=compiled"] if kernel == SHIPPED else ["env", "EMB_CORE=python"]
        actor = ("--policy", str(NETWORK)) if kernel == "qemu" else ()
        perform(PLAYED[kernel], folder / kernel, emb_hil, run=actor)

    with ThreadPoolExecutor(len(KERNELS)) as boots:
        list(boots.map(boot, KERNELS))
    watchdog_ms = 1e3 * load_bench().node.watchdog

    def get(kernel: str, play: Play) -> tuple[Seen, Verdict]:
        it = seen(play, folder / kernel)
        return it, judge(it, watchdog_ms)

    return get


@pytest.mark.parametrize(("kernel", "play"), CASES)
def test_nothing_is_as_it_must_not_be(played: Played, kernel: str, play: Play) -> None:
    _, verdict = played(kernel, play)
    assert verdict.wrong == ()


@pytest.mark.parametrize("name", WITH_TIME)
def test_where_the_processor_has_time_it_is_told_for_what_it_is(played: Played, name: str) -> None:
    it, _ = played("uml", next(play for play in PLAYS if play.name == name))
    assert it.summary["result"] == WITH_TIME[name]


@pytest.mark.parametrize("kernel", KERNELS)
def test_no_period_is_missed_and_all_but_a_few_samples_are_answered_in_time(played: Played, kernel: str) -> None:
    it, _ = played(kernel, NORMAL)
    assert (it.summary["missed"], it.summary["log_dropped"]) == (0, 0)
    # A command that comes too late for its period, on a processor that is used to nine tenths, is one of the few.
    assert it.summary["answered"] - it.summary["not_obeyed"] >= 495


@pytest.mark.parametrize(("kernel", "play"), [case for case in CASES if not str(case.id).endswith("disk_full")])
def test_a_log_holds_all_that_was_on_the_bus_but_its_last_half_second_at_worst(
    played: Played, kernel: str, play: Play
) -> None:
    _, verdict = played(kernel, play)
    assert verdict.frames_lost is not None
    assert verdict.frames_lost <= play.may_lose


def test_what_the_killed_left_can_be_evaluated_and_rerun(played: Played) -> None:
    it, _ = played("uml", KILLED)
    assert replay(["fim", str(it.log), "--json"]) == 0
    assert replay(["rerun", str(it.log)]) == 0
