"""Every scenario that is played on a bus, against the programs as shipped, on a real SocketCAN bus, in one boot."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from emb_bench.cli.replay import main as replay
from emb_bench.logs.log import read_log
from emb_runtime.config.bench import load_bench
from tests.drives import SHIPPED
from tests.hil.judge import WATCHDOG_MS, Seen, judge, seen
from tests.hil.plays import ROOT, SLOWLY, perform
from tests.independent import DATABASE
from tests.scenarios.injections import ANGLE, COMMAND, STATUS, VELOCITY
from tests.scenarios.table import ON_BUS, Scenario

WHOLE = tuple(f"mapped_{drive}" for drive in SHIPPED)  # Undisturbed runs of drives behind the gateway


def is_nightly(play: Scenario) -> bool:
    """Faults of mapped drives, which are also played in lock-step: tests/runtime/drives."""
    return play.name.startswith("mapped_") and play.name not in WHOLE


CASES = [
    pytest.param(play, id=play.name, marks=pytest.mark.slow if is_nightly(play) else ()) for play in ON_BUS.values()
]
UNHEARD = ("loop_stopped", "loop_killed", "loop_hung", "loop_robbed")
"""The loop cannot send its stop frames: the watchdog does."""
pytestmark = pytest.mark.timeout(3200)  # far beyond what a busy computer needs

Played = Callable[[str], Seen]


@pytest.fixture(scope="session")
def played(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Played:
    """All plays that the selected tests need, played once."""
    folder: Path = tmp_path_factory.mktemp("plays")
    wanted: set[str] = set()
    for item in request.session.items:
        if callspec := getattr(item, "callspec", None):
            wanted |= {value.name for value in callspec.params.values() if isinstance(value, Scenario)}
        if marker := item.get_closest_marker("plays"):
            wanted |= set(marker.args)
    perform([play for play in ON_BUS.values() if play.name in wanted], folder)
    return lambda name: seen(ON_BUS[name], folder)


@pytest.mark.parametrize("play", CASES)
def test_nothing_is_as_it_must_not_be(played: Played, play: Scenario) -> None:
    """Results, commands, stop frames, stop time, limits, processes: each rule of tests/hil/judge.py; then the log."""
    verdict = judge(played(play.name))
    assert verdict.wrong == ()
    if play.name != "disk_full" and not play.drive:
        assert verdict.frames_lost is not None
        assert verdict.frames_lost <= play.may_lose


@pytest.mark.plays("normal")
def test_of_an_undisturbed_run_each_sample_is_answered_once_and_both_ends_agree(played: Played) -> None:
    it = played("normal")
    summary, (node,) = it.summary, it.told
    assert (summary["answered"], summary["missed"], summary["log_dropped"]) == (500, 0, 0)
    assert summary["pairs"] == summary["answered"] + summary["unanswered"] + 1
    assert summary["answered"] - summary["not_obeyed"] == node["obeyed"] >= 495
    # From the frames alone: each enabled command names a pair that was on the bus before it, and none is named twice.
    pairs: list[int] = []
    answered: list[int] = []
    for _, identifier, data in it.frames:
        if identifier == VELOCITY:
            pairs.append(data[1] & 0x0F)
        elif identifier == COMMAND and data[4] & 1:
            answered.append(len(pairs) - 1 - (pairs[-1] - (data[1] >> 4)) % 15)
    assert answered == sorted(set(answered))
    assert len(answered) == summary["answered"]


def unwrapped(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, without its line ends."""
    return " ".join(capsys.readouterr().out.split())


@pytest.mark.plays("normal")
def test_its_log_holds_every_frame_with_its_direction_and_is_evaluated(
    played: Played, capsys: pytest.CaptureFixture[str]
) -> None:
    it = played("normal")
    log = read_log(it.log)
    assert log.complete
    logged = [(frame.identifier, frame.data) for frame in log.frames]
    on_bus = [(identifier, data) for _, identifier, data in it.frames]
    start = next(n for n in range(len(on_bus)) if on_bus[n : n + 40] == logged[:40])
    assert on_bus[start : start + len(logged)] == logged
    assert {frame.identifier for frame in log.frames if frame.own} == {COMMAND}
    assert {frame.identifier for frame in log.frames if not frame.own} == {ANGLE, VELOCITY, STATUS}
    assert sum(frame.own for frame in log.frames) == len(it.commands())
    assert all(int(b) > int(a) for a, b in pairwise(log.cycles["device_time_ns"]))
    assert log.bench.identity_hash == load_bench().identity_hash
    assert replay(["fim", str(it.log), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["physical"]["log_det"] > 60.0
    assert all(0.0 < value < 0.1 for value in report["physical"]["cramer_rao"].values())
    assert replay(["rerun", str(it.log)]) == 0
    assert replay(["timing", str(it.log)]) == 2
    assert "time ran 1000 times slower" in unwrapped(capsys)


@pytest.mark.plays(*UNHEARD)
def test_the_watchdog_stops_a_loop_that_cannot_and_the_node_obeys_it(played: Played) -> None:
    for name in UNHEARD:
        it = played(name)
        times = [(it.run_frames[n][0], values["Enable"]) for n, values in it.commands()]
        stops, last = [t for t, enable in times if not enable], max(t for t, enable in times if enable)
        resumed_ns = it.report["done"][-1][1]
        if name != "loop_killed":  # a process that has ended is noticed at once
            assert stops[-1] < resumed_ns, name
            assert stops[0] - last >= 0.9e9 * load_bench().watch.heartbeat, name
        # The processor that a robbed loop keeps busy counts as taken from the watchdog, which then waits two
        # heartbeats: as long as the node's own watchdog.
        assert it.told[0]["stop_reason"] in ("DISABLED", *(("WATCHDOG",) if name == "loop_robbed" else ())), name


@pytest.mark.plays("loop_and_watchdog_killed")
def test_without_its_watchdog_process_a_killed_loop_is_stopped_by_the_node_s_own(played: Played) -> None:
    it = played("loop_and_watchdog_killed")
    assert it.told[0]["stop_reason"] == "WATCHDOG"
    stop_ms = judge(it).stop_ms
    assert stop_ms is not None
    assert stop_ms >= WATCHDOG_MS - 0.5


@pytest.mark.plays("loop_stopped")
def test_a_loop_that_goes_on_says_that_its_watchdog_has_tripped(played: Played) -> None:
    summary = played("loop_stopped").summary
    watchdog = summary["watchdog"]
    assert (watchdog["tripped"], watchdog["frames"], watchdog["error"]) == ("stalled", 3, "")
    assert watchdog["silence_ns"] >= load_bench().watch.heartbeat * 1e9
    assert summary["log_complete"]


@pytest.mark.plays("loop_killed", "loop_and_recorder_killed")
def test_what_the_killed_left_can_be_evaluated(played: Played, capsys: pytest.CaptureFixture[str]) -> None:
    killed, cut = played("loop_killed"), played("loop_and_recorder_killed")
    sent = sum(values["Enable"] for _, values in killed.commands())
    logged = int((read_log(killed.log).signals("EMB_Command")["Enable"] == 1).sum())
    assert abs(logged - sent) <= 2
    assert replay(["fim", str(killed.log)]) == 0
    assert "died" in capsys.readouterr().out
    assert replay(["rerun", str(killed.log)]) == 0
    log = read_log(cut.log)
    assert not log.complete
    assert "cut" in log.missing or "closed" in log.missing
    capsys.readouterr()
    assert replay(["fim", str(cut.log)]) == 0
    assert log.missing.split(";")[0] in unwrapped(capsys)


DRIVE_FRAMES = ((0x00E, 0x009), (0x105, 0x905), (1, 2))  # Commands and samples of the three


def gateway(it: Any) -> dict[str, str]:
    counts: dict[str, str] = json.loads(it.report["gateways"][0]["out"])
    return counts


def is_whole(it: Any) -> None:
    """Each sample was answered by the drive, and nothing was refused."""
    assert (it.summary["answered"], it.summary["not_obeyed"], it.summary["log_complete"]) == (500, 0, True)
    assert (it.summary["watchdog"]["tripped"], gateway(it)["drive_frames_refused"]) == ("", "0")
    assert it.report["gateways"][0]["exit"] == 0, it.report["gateways"][0]["err"]


@pytest.mark.plays(*WHOLE)
def test_a_drive_behind_the_gateway_answers_every_sample_and_its_frames_are_in_the_log(played: Played) -> None:
    for name, (commands, samples) in zip(WHOLE, DRIVE_FRAMES, strict=True):
        it = played(name)
        is_whole(it)
        logged = read_log(it.log).tables["/drive/rx"]["id"].tolist()
        assert logged.count(commands) >= 500, name  # of the gateway, beside what the drive sends
        assert logged.count(samples) >= 500, name
    assert gateway(played("mapped_odrive"))["drive_time_out"].startswith("disarmed within 0.01")


@pytest.mark.slow
@pytest.mark.plays(*(f"{name}_host" for name in WHOLE), "mapped_zero", "mapped_left", "mapped_gateway", "mapped_down")
def test_a_mapped_drive_is_let_go_when_its_host_dies_and_gets_no_current_with_zero(played: Played) -> None:
    zero = played("mapped_zero")
    is_whole(zero)
    assert (gateway(zero)["drive_too_late"], zero.told[0]["top_speed"]) == ("", 0.0)
    for name in WHOLE:
        assert played(f"{name}_host").told[0]["top_speed"] > 300.0  # it was killed in motion
    left = played("mapped_left")
    assert left.told[0]["top_speed"] <= load_bench().limits.velocity  # the gateway brakes by itself
    for name, code in (("mapped_left", 3), ("mapped_down", 4)):
        assert played(name).report["gateways"][0]["exit"] == code


@pytest.fixture(scope="module")
def unguarded() -> dict[str, Any]:
    hil = ["timeout", "300", sys.executable, "-m", "emb_bench.hil.cli", *SLOWLY, "--"]
    command = [*hil, sys.executable, "-m", "tests.hil.unguarded_loop"]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-3000:]
    return dict(json.loads(done.stdout))


def test_after_the_trip_the_kernel_refuses_what_even_a_loop_without_a_guard_sends(unguarded: dict[str, Any]) -> None:
    assert unguarded["before"] == ""
    assert "vcan0" in unguarded["after"]
    decoded = [DATABASE.decode_message(i, bytes.fromhex(d), decode_choices=False) for i, d in unguarded["frames"][:-1]]
    assert [(values["Counter"], values["Enable"]) for values in decoded] == [(0, 1), (1, 0), (2, 0), (3, 0)]
    result = unguarded["result"]
    assert (result["tripped"], result["frames"], result["error"]) == ("stalled", 3, "")
    assert result["realtime"]["scheduler"] == "FIFO 90"  # above the loop
    # And it still receives what is on its bus.
    assert unguarded["heard"] == [COMMAND, COMMAND, COMMAND, COMMAND, 0x123]
