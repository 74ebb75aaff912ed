"""Duration of a control cycle on this computer, natively: from having the sensor pair to the command handed over.

    python benchmarks/cycle.py [--seconds 10] [--actor structured.onnx]

``emb-run`` as it is, with policy, guard, shield and logging into a real recorder, on a pair of local sockets that carry
``struct can_frame`` instead of a CAN interface; a simulated brake at the other end, in another process, at 1 kHz.
The times are those in the log. A second run with a stop-watch around each step gives the breakdown, a little longer in
total; there is none for the compiled core (``EMB_CORE=compiled``, after ``python -m tools.compile_core``), in which no
function can be replaced. Exit code 0 if the median is at most 60 us and 99.9 % of the cycles take at most 150 us.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.bus.long_run import long_bench, write_both
from benchmarks.bus.pair import local_bus, node_on_a_pair
from emb_bench.logs.log import read_log
from emb_bench.logs.timing import Floats, timing
from emb_runtime.can.receiver import Reception
from emb_runtime.can.transport import SocketCan, Transport
from emb_runtime.cli import experiment, session
from emb_runtime.cli import main as run
from emb_runtime.config.bench import Bench
from emb_runtime.control import core, loop, phases
from emb_runtime.control.result import Outcome
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.log.recorder import Recorder
from emb_runtime.policy.policy import Policy
from emb_runtime.safety.guard import Guard
from emb_runtime.system import compiled_core
from emb_runtime.system.clock import Clock, MonotonicClock

LIMITS = {50.0: 60e-6, 99.9: 150e-6}  # Limits of the cycle's work [s], by quantile
STEPS: dict[str, tuple[Any, str]] = {
    "reading a frame (after the wait)": (SocketCan, "_read_socket"),
    "reception": (Reception, "add_frame"),
    "estimator": (Estimator, "add_sample"),
    "policy": (Policy, "act"),
    "clip, slew, shield": (phases, "decide"),
    "permission, encoding, guard": (core.Core, "answer"),
    "  of it, the guard": (Guard, "check"),
    "bus": (Guard, "send"),
    "recording": (Recorder, "push"),
}


class Run(NamedTuple):
    """One run."""

    work: Floats  # Times from the pair's receipt by the loop to the command's handing over to the bus [s]
    age: Floats  # Times from the pair's arrival to its receipt by the loop [s]
    busy: float  # Processor time per cycle, everything included [s]
    steps: dict[str, Floats]  # Time of each call, by step [s]
    answered: int
    missed: int
    messages: int  # In the log
    realtime: str  # Settings that were obtained


def main() -> int:
    """Measure and print; gives the exit code."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--seconds", type=float, default=10.0, metavar="S", help="of each run (default: %(default)g)")
    p.add_argument("--actor", type=Path, metavar="FILE", help="of emb-export (default: the shipped one)")
    args = p.parse_args()
    samples = round(args.seconds * 1000)
    taken = compiled_core.running()
    plain = run_once(samples, args.actor)
    print(f"core: {taken.text}; {plain.answered} of {samples} samples answered; {plain.realtime}")
    quantiles = (50.0, 90.0, 99.0, 99.9, 100.0)
    print(f"{'':34}" + "".join(f"{q:9g} %" for q in quantiles))
    for title, values in (
        ("pair arrived to pair in hand", plain.age),
        ("pair in hand to command sent", plain.work),
        ("pair arrived to command sent", plain.age + plain.work),
    ):
        print(f"{title:34}" + "".join(f"{1e6 * v:8.1f} us" for v in np.percentile(values, quantiles)))
    print(
        f"processor time per cycle, waiting excluded: {1e6 * plain.busy:.1f} us, {plain.busy / 1e-3:.1%} of the period"
    )
    if not taken.compiled:
        watched = run_once(samples, args.actor, STEPS)
        print(f"{'step':34}{'median':>11}{'per cycle':>11}")
        for title, values in watched.steps.items():
            print(f"{title:34}{1e6 * np.median(values):8.1f} us{len(values) / watched.answered:11.2f}")
    met = True
    for quantile, limit in LIMITS.items():
        got = float(np.percentile(plain.work, quantile))
        met &= got <= limit
        missed = "" if got <= limit else ", **not met**"
        print(
            f"| pair in hand to command sent, {taken.text}: {quantile:g} % of the cycles within | "
            f"{1e6 * limit:.0f} µs | {1e6 * got:.0f} µs{missed} |"
        )
    return EXIT_DONE if met else EXIT_CHECK_FAILED


def run_once(
    samples: int,
    actor_file: Path | None = None,
    watched: dict[str, tuple[Any, str]] | None = None,
    options: Sequence[str] = (),
) -> Run:
    """One run of ``emb-run``.

    Args:
        samples: its length.
        actor_file: an actor; None for the shipped one.
        watched: functions that get a stop-watch, by step.
        options: further options of ``emb-run``.
    """
    clock = MonotonicClock()
    steps: dict[str, list[int]] = defaultdict(list)
    busy = [0.0]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="emb-cycle-")))
        bench, actor = write_both(folder, samples, actor_file)
        end = stack.enter_context(node_on_a_pair(long_bench(samples)))

        def open_it(_iface: str, _bench: Bench, *_: Any, **__: Any) -> tuple[Transport, Clock]:
            return local_bus(end, clock), clock

        stack.enter_context(mock.patch.object(experiment, "open_transport", open_it))
        stack.enter_context(mock.patch.object(session, "Loop", lambda **given: _Counted(loop.Loop(**given), busy)))
        for title, (owner, name) in (watched or {}).items():
            stack.enter_context(_stopwatch(owner, name, steps[title]))
        log = folder / "run.mcap"
        arguments = ["--iface", "pair", "--bench", str(bench), "--policy", str(actor), "--log", str(log)]
        with contextlib.redirect_stdout(io.StringIO()) as out:
            code = run.main([*arguments, "--json", "--yes", "--no-watchdog", "--long-timeouts", *options])
        document = json.loads(out.getvalue().splitlines()[-1])
        if not log.exists():
            raise SystemExit(f"emb-run ended with {code}: {document}")
        found = timing(read_log(log))
    return Run(
        work=found.decision + found.sending,
        age=found.age,
        busy=busy[0] / len(found.response),
        steps={name: 1e-9 * np.array(values) for name, values in steps.items()},
        answered=len(found.response),
        missed=document["missed"],
        messages=document["log_messages"],
        realtime=", ".join(f"{k} {v}" for k, v in document.get("realtime", {}).items()),
    )


class _Counted:
    """A loop; the processor time of this thread that its run takes is added."""

    def __init__(self, inner: loop.Loop, busy: list[float]) -> None:
        self._inner, self._busy = inner, busy

    def run(self) -> Outcome:
        before = time.thread_time()
        try:
            return self._inner.run()
        finally:
            self._busy[0] += time.thread_time() - before


@contextmanager
def _stopwatch(owner: Any, name: str, durations: list[int]) -> Iterator[None]:
    original = getattr(owner, name)
    now, keep = time.perf_counter_ns, durations.append

    def timed(*args: Any, **kwargs: Any) -> Any:
        before = now()
        try:
            return original(*args, **kwargs)
        finally:
            keep(now() - before)

    with mock.patch.object(owner, name, timed):
        yield


if __name__ == "__main__":
    sys.exit(main())
