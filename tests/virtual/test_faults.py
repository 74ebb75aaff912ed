"""Every fault of tests/hil/faults.py, against the programs as shipped, in the QEMU kernel's virtual time.

Apart from the other tests, because they take a quarter of an hour on two processors: ``make test-virtual``.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from emb_bench.replay import main as replay
from emb_runtime.bench import load_bench

from tests.hil.faults import PLAYS, Play, Seen, Verdict, judge, perform, seen  # isort: skip

HIL = [sys.executable, "-m", "emb_bench.hil.cli", "--qemu", "--root", "--timeout", "3000", "--"]
BOOTS = min(4, len(os.sched_getaffinity(0)))
"""Kernels at a time. Each keeps one processor busy, and what that one does besides is nothing to virtual time."""
BOOT_OF = {play.name: (play, n % BOOTS) for n, play in enumerate(PLAYS)}
pytestmark = pytest.mark.timeout(3200)  # far beyond what a busy computer needs


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Seen, Verdict]]:
    """All of them, played once."""
    folder: Path = tmp_path_factory.mktemp("faults")
    with ThreadPoolExecutor(BOOTS) as boots:
        list(boots.map(lambda boot: perform(PLAYS[boot::BOOTS], folder / str(boot), HIL), range(BOOTS)))
    watchdog_ms = 1e3 * load_bench().node.watchdog

    def get(name: str) -> tuple[Seen, Verdict]:
        play, boot = BOOT_OF[name]
        it = seen(play, folder / str(boot))
        return it, judge(it, watchdog_ms)

    return get


@pytest.mark.parametrize("play", PLAYS, ids=lambda play: play.name)
def test_nothing_is_as_it_must_not_be(played: Callable[[str], tuple[Seen, Verdict]], play: Play) -> None:
    _, verdict = played(play.name)
    assert verdict.wrong == ()


def test_in_virtual_time_no_period_is_missed_and_all_but_a_few_samples_are_answered(
    played: Callable[[str], tuple[Seen, Verdict]],
) -> None:
    it, _ = played("normal")
    assert (it.summary["missed"], it.summary["not_obeyed"]) == (0, 0)
    assert it.summary["answered"] >= 495  # the one processor is nine tenths busy there


@pytest.mark.parametrize("name", [play.name for play in PLAYS if play.name != "disk_full"])
def test_a_log_holds_all_that_was_on_the_bus_but_its_last_half_second_at_worst(
    played: Callable[[str], tuple[Seen, Verdict]], name: str
) -> None:
    _, verdict = played(name)
    assert verdict.frames_lost is not None
    assert verdict.frames_lost <= BOOT_OF[name][0].may_lose


def test_what_the_killed_left_can_be_evaluated_and_rerun(played: Callable[[str], tuple[Seen, Verdict]]) -> None:
    log = str(played("loop_killed")[0].log)
    assert replay(["fim", log, "--json"]) == 0
    assert replay(["rerun", log]) == 0
