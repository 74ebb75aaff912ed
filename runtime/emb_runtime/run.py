"""``emb-run``: one guarded experiment on a bench, logged."""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from emb_runtime import realtime
from emb_runtime.bench import Bench, load_bench, shipped_bench_text
from emb_runtime.clock import Clock
from emb_runtime.errors import EXIT_DONE, EXIT_LOG_INCOMPLETE, BenchFileError, EmbError, LogError, UsageError
from emb_runtime.frames import Layout, load_layout
from emb_runtime.guard import Guard
from emb_runtime.loop import Loop, Outcome
from emb_runtime.policy import Policy, load_policy, shipped_actor_path
from emb_runtime.recorder import Attachment, LogHeader, Recorder, RecorderResult
from emb_runtime.records import Frame
from emb_runtime.ring import Direction, Level
from emb_runtime.shield import make_law
from emb_runtime.states import FAULTS, Fault
from emb_runtime.terminal import complain, show
from emb_runtime.transport import Transport, open_transport

HIGHEST_BUS_LOAD = 0.8
"""Beyond it, at worst-case bit stuffing, frames wait for each other."""

EPILOG = """\
exit codes:
  0  the experiment was completed, and its log is whole
  2  usage: wrong argument, unreadable file, bench file refused, log cannot be written
  3  safety stop: a fault, Ctrl-C or SIGTERM ended the run with stop frames
  4  bus: the interface cannot be opened, was lost, or no node is on it
  5  the policy was refused: damaged, or made for another bench
  6  the experiment was completed, but its log is not whole (disk full, recorder killed)

examples:
  emb-run --iface sim --json                        the shipped actor on the simulated brake, in lock-step
  emb-run --iface sim:seed=3,f_v=4e-5               another brake, other noise
  emb-run --iface sim:plant=stribeck                one of the plants in the bench file (--write-bench shows them)
  emb-run --iface vcan0 --policy actor.onnx         a real SocketCAN bus, with emb-node on it
  emb-hil -- sh -c 'emb-node --iface vcan0 & emb-run --iface vcan0 --log /dev/shm/run.mcap; mv /dev/shm/run.mcap .'
                                                    where the kernel has no CAN
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog="emb-run",
        description="Run one excitation experiment: read the brake's sensors at 1 kHz over CAN, let the policy decide, "
        "keep it inside the limits (clip, envelope shield, guard), log everything to one MCAP file, and stop safely "
        "on every way out.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument(
        "--iface", default="sim", metavar="NAME",
        help="SocketCAN interface (can0, vcan0), 'sim' (lock-step, no CAN needed), or python-can BACKEND:CHANNEL "
        "(default: sim)",
    )  # fmt: skip
    p.add_argument("--policy", type=Path, metavar="FILE", help="actor as ONNX with its contract (default: shipped)")
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench description (default: the shipped drum brake)")
    p.add_argument(
        "--log", type=Path, default=Path("runs"), metavar="FILE|DIR",
        help="MCAP file to write, or a folder for one named after the time (default: runs/)",
    )  # fmt: skip
    p.add_argument("--duration", type=float, metavar="S", help="shorter experiment (default: the policy's horizon)")
    p.add_argument("--cpu", type=int, metavar="N", help="pin the loop to this processor")
    p.add_argument("--no-rt", action="store_true", help="leave scheduling and memory alone")
    p.add_argument("--json", action="store_true", help="print the summary as JSON")
    p.add_argument("--write-bench", type=Path, metavar="FILE", help="write the shipped bench description and exit")
    p.add_argument("--version", action="version", version=f"emb-run {metadata.version('emb-excite')}")
    return p


class _StopRequest:
    """Set by Ctrl-C and its kin, asked by the loop. Taken first of all, so that none of them is ever a traceback."""

    def __init__(self) -> None:
        self._requested = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:  # nohup asked for that one to be ignored
                signal.signal(number, self._request)

    def __call__(self) -> bool:
        return self._requested

    def _request(self, _signal: int, _frame: object) -> None:
        self._requested = True


class _RecorderJournal:
    """The loop's journal, into the recorder. A frame whose echo came back is one that we sent."""

    def __init__(self, recorder: Recorder) -> None:
        self.push_cycle = recorder.push_cycle
        self.push_event = recorder.push_event
        self.push_log = recorder.push_log
        self._push = recorder.push_frame

    def push_frame(self, frame: Frame) -> None:
        self._push(frame, Direction.TX if frame.own else Direction.RX)


@dataclass(frozen=True)
class _Setup:
    """All that is needed before anything is opened."""

    bench: Bench
    layout: Layout
    policy: Policy
    steps: int
    log: Path
    """As the user said it: a file, or a folder."""


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``emb-run``."""
    args = parser().parse_args(argv)
    stop = _StopRequest()
    try:
        if args.write_bench is not None:
            return _write_bench(args.write_bench)
        return _run(_prepare(args), args, stop)
    except EmbError as err:
        return complain("emb-run", err)


def _prepare(args: argparse.Namespace) -> _Setup:
    bench = load_bench(args.bench)
    horizon = bench.timing.horizon
    steps = horizon
    if args.duration is not None:
        if not bench.timing.sample_time <= args.duration <= horizon * bench.timing.sample_time:
            raise UsageError(
                f"--duration: expected {bench.timing.sample_time:g} to {horizon * bench.timing.sample_time:g} s, "
                f"the horizon of the bench, got {args.duration:g}"
            )
        steps = round(args.duration / bench.timing.sample_time)
    if args.cpu is not None and args.cpu not in os.sched_getaffinity(0):
        raise UsageError(f"--cpu: expected one of {sorted(os.sched_getaffinity(0))}, got {args.cpu}")
    layout = load_layout()
    _check_bus(bench, layout)
    policy = load_policy(args.policy if args.policy is not None else shipped_actor_path(), bench)
    return _Setup(bench, layout, policy, steps, args.log)


def _check_bus(bench: Bench, layout: Layout) -> None:
    """Refuse a bench whose sampling contradicts the DBC's, or whose bus cannot carry it."""
    period = layout.command.cycle_time
    if abs(bench.timing.sample_time - period) > 1e-9:
        raise BenchFileError(
            f"timing.sample_time: the DBC's command comes every {period:g} s, got {bench.timing.sample_time:g} s"
        )
    if (load := layout.bus_load(bench.can.bitrate)) > HIGHEST_BUS_LOAD:
        raise BenchFileError(
            f"can.bitrate: at {bench.can.bitrate} bit/s the messages would take {load:.0%} of the bus at worst, "
            f"expected at most {HIGHEST_BUS_LOAD:.0%}"
        )


def _run(setup: _Setup, args: argparse.Namespace, stop: _StopRequest) -> int:
    bench, layout = setup.bench, setup.layout
    law = make_law(bench)._replace(steps=setup.steps)
    transport, clock = open_transport(args.iface, bench)
    try:
        # The recorder starts first: it must not inherit the loop's scheduling.
        recorder = _start_recorder(setup, args.iface, transport, clock)
    except BaseException:
        transport.close()
        raise
    outcome = None
    obtained: dict[str, str] = {}
    try:
        journal = _RecorderJournal(recorder)
        simulated = transport.truth is not None
        obtained = {} if args.no_rt or simulated else realtime.obtain(cpu=args.cpu)
        for name, value in obtained.items():
            journal.push_log(clock.now_ns(), Level.INFO, f"real time, {name}: {value}")
        _push_clock(recorder, clock)
        outcome = Loop(
            bench=bench,
            layout=layout,
            law=law,
            actor=setup.policy,
            current_limit=setup.policy.contract.action_limit,
            steps=setup.steps,
            guard=Guard(layout, bench, transport.send),
            receive=_unhurried(transport, recorder) if simulated else transport.receive,
            clock=clock,
            journal=journal,
            stop_requested=stop,
        ).run()
        _push_clock(recorder, clock)
    finally:
        transport.close()
        result = recorder.finish(trailer(outcome, obtained))
    summary = _summary(setup, args.iface, outcome, result, obtained)
    show(json.dumps(summary) if args.json else _text(summary))
    return int(summary["exit_code"])


def _exit_code(outcome: Outcome, result: RecorderResult) -> int:
    if outcome.fault is not None:
        return FAULTS[outcome.fault].exit_code
    return EXIT_DONE if result.complete else EXIT_LOG_INCOMPLETE


def _unhurried(transport: Transport, recorder: Recorder) -> Callable[[int], Frame | None]:
    """Receive from a simulated bus, whose time stands still while the recorder catches up."""

    def receive(deadline_ns: int) -> Frame | None:
        recorder.wait_for_room()
        return transport.receive(deadline_ns)

    return receive


def _push_clock(recorder: Recorder, clock: Clock) -> None:
    now_ns = clock.now_ns()
    recorder.push_clock(now_ns, now_ns + clock.wall_offset_ns())


def _start_recorder(setup: _Setup, iface: str, transport: Transport, clock: Clock) -> Recorder:
    bench, policy = setup.bench, setup.policy
    records = {
        "emb.run": {
            "tool": f"emb-excite {metadata.version('emb-excite')}",
            "command": shlex.join(sys.argv).encode("utf-8", "replace").decode(),
            "iface": iface,
            "steps": str(setup.steps),
            "bench_name": bench.name,
            "bench_hash": bench.contract_hash,
            "dbc_protocol": str(setup.layout.protocol_version),
            "bus_load_worst": f"{setup.layout.bus_load(bench.can.bitrate):.4f}",
            "policy_sha256": policy.sha256,
            "policy_provenance": json.dumps(dict(policy.contract.provenance), sort_keys=True),
            "python": platform.python_version(),
            "onnxruntime": metadata.version("onnxruntime"),
            "kernel": f"{platform.system()} {platform.release()} {platform.machine()}",
        }
    }
    truth = transport.truth
    if truth is not None:
        records["emb.truth"] = {name: str(value) for name, value in truth.items()}
    header = LogHeader(
        start_ns=clock.now_ns(),
        wall_offset_ns=clock.wall_offset_ns(),
        simulated=truth is not None,
        dbc=setup.layout.text,
        metadata=records,
        attachments=(
            Attachment("policy.onnx", "application/octet-stream", policy.data),
            Attachment("bench.toml", "application/toml", bench.text.encode()),
        ),
    )
    try:
        path = _log_path(setup.log)
        path.parent.mkdir(parents=True, exist_ok=True)
        return Recorder.start(path, header)
    except OSError as err:
        raise UsageError(f"--log {setup.log}: {err.strerror}") from err
    except LogError as err:
        raise UsageError(f"--log: {err}") from err


def _log_path(wanted: Path) -> Path:
    """A file is taken as it is; anything without a suffix is a folder, in which the time names the file.

    Raises:
        OSError: the path cannot be looked at.
    """
    if wanted.suffix and not wanted.is_dir():
        return wanted
    name = time.strftime("%Y%m%d-%H%M%S") + f"-{time.time_ns() // 1_000_000 % 1000:03d}"
    return wanted / f"run-{name}.mcap"


def trailer(outcome: Outcome | None, obtained: dict[str, str]) -> dict[str, str]:
    """What the log says of the outcome; ``obtained`` are the real-time settings."""
    if outcome is None:
        return {"exit_reason": Fault.INTERNAL.name, "detail": "the run ended before the loop did"}
    said = {"exit_reason": outcome.fault.name if outcome.fault else "DONE", "detail": outcome.detail}
    said |= {name: str(value) for name, value in asdict(outcome.tally).items()}
    said |= {"home": str(outcome.home), "node_at_rest": str(outcome.node_at_rest)}
    if outcome.node_stop_reason is not None:
        said["node_stop_reason"] = outcome.node_stop_reason.name
    return said | {f"rt_{name}": value for name, value in obtained.items()}


def _summary(
    setup: _Setup, iface: str, outcome: Outcome, result: RecorderResult, obtained: dict[str, str]
) -> dict[str, Any]:
    fault = outcome.fault
    return {
        "result": "done" if fault is None else fault.name,
        "exit_code": _exit_code(outcome, result),
        "cause": FAULTS[fault].cause if fault else "",
        "detail": outcome.detail,
        "advice": FAULTS[fault].advice if fault else "",
        "iface": iface,
        "bench": setup.bench.name,
        "steps": setup.steps,
        "duration_s": outcome.duration_ns * 1e-9,
        **asdict(outcome.tally),
        "home": outcome.home,
        "end_angle": _number(outcome.end_angle),
        "end_velocity": _number(outcome.end_velocity),
        "node_state": outcome.node_state.name if outcome.node_state is not None else None,
        "node_at_rest": outcome.node_at_rest,
        "node_stop_reason": outcome.node_stop_reason.name if outcome.node_stop_reason is not None else None,
        "last_angle": _number(outcome.last_angle),
        "realtime": obtained,
        "log": str(result.path),
        "log_messages": result.messages,
        "log_bytes": result.bytes,
        "log_dropped": result.dropped,
        "log_complete": result.complete,
        "log_error": result.error,
    }


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return value if value == value else None


def _text(s: dict[str, Any]) -> str:
    head = (
        f"done: {s['answered']} of {s['steps']} samples answered"
        if s["result"] == "done"
        else f"STOPPED ({s['result']}): {s['cause']}{': ' + s['detail'] if s['detail'] else ''}\n  → {s['advice']}"
    )
    lines = [head]
    if s["pairs"]:
        lines += [
            f"  brake      {s['angle_min']:.2f} to {s['angle_max']:.2f} rad, top speed {s['top_speed']:.1f} rad/s, "
            f"top current {s['top_current']:.2f} A",
            f"  end        {s['end_angle']:.3f} rad, {s['end_velocity']:.1f} rad/s at the last sample in control: "
            f"{'home' if s['home'] else 'NOT HOME'}",
            f"  afterwards {s['last_angle']:.3f} rad, the node is {s['node_state']}"
            f"{', at rest' if s['node_at_rest'] else ', still stopping'}"
            f"{_stop_reason(s['node_stop_reason'], s['answered'] > s['not_obeyed'])}",
            f"  commands   {s['answered']} sent, {s['limited']} limited by the shield, {s['returning']} to return, "
            f"{s['clipped']} clipped, {s['not_obeyed']} came too late",
            f"  samples    {s['pairs']} pairs, {s['unanswered']} unanswered, {s['missed']} periods missed, "
            f"{s['rejected']} frames rejected, {s['dropped']} dropped by the kernel",
        ]
    missing = "" if s["log_complete"] else f", INCOMPLETE: {s['log_error']}"
    if lacking := [name for name, value in s["realtime"].items() if value.startswith("not obtained")]:
        lines.append(f"  real time  NOT OBTAINED: {', '.join(lacking)}; --json says why, --no-rt does not ask")
    lines.append(f"  log        {s['log']} ({s['log_messages']} messages, {s['log_bytes'] / 1024:.0f} KiB{missing})")
    return "\n".join(lines)


def _stop_reason(name: str | None, obeyed: bool) -> str:
    if name == "NEVER_COMMANDED" and obeyed:  # the status message is older than the experiment
        return " (it has not told its stop reason yet)"
    return "" if name in (None, "NONE") else f" (its latest stop reason: {name})"


def _write_bench(path: Path) -> int:
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(shipped_bench_text())
    except OSError as err:
        raise BenchFileError(f"{path}: cannot write the bench file: {err.strerror}") from err
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
