"""Commissioning in a folder: a run of ``emb-run`` for each step, whose log is examined before the next one."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from emb_bench.commission import examination
from emb_bench.commission.bench_file import WRITTEN, found_text, measured_ranges, working_text
from emb_bench.commission.records import Findings, Identification, Kind, Step
from emb_bench.commission.steps import WIDENING, judged, next_step, suspected
from emb_bench.config.bench import Bench, load_bench, parse_bench
from emb_runtime.can.messages import bench_identity
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.config.toml_text import parse_toml
from emb_runtime.errors import EXIT_DONE, EXIT_SAFETY_STOP, SafetyStopError, UsageError
from emb_runtime.policy.contract import CONTRACT_KEY, MIN_VECTORS, SAMPLE, Contract, PolicyLimits, Vector
from emb_runtime.safety.state_machine import Fault
from emb_runtime.system import terminal

WORKING, LEARNING_FILE, FOUND = "working.toml", "working-learning.toml", "bench.toml"
"""Names of the bench files in the folder."""
RECENT = 2  # Experiments that the parameters are estimated from: each is larger and tells more than those before it
MOST_ATTEMPTS = 100  # Logs of one step
OUTSIDE = {Fault.OUT_OF_LIMITS.name, Fault.MOTION_OUTSIDE_SET.name, Fault.SET_CONTRADICTED.name}
"""Results by which the brake may lie outside of the data sheet's ranges."""
SIMULATED = ("sim", "sim-drive")  # Buses whose brake is made anew for each run

Run = Callable[[Sequence[str]], Mapping[str, Any]]
"""A run of ``emb-run --json`` with these arguments; the document that it prints."""


class StepFailedError(SafetyStopError):
    """A step was not completed; the command ends with the exit code of its run."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


@dataclass(frozen=True)
class Commissioned:
    """Result of a commissioning."""

    bench: Path  # The file that was found
    ranges: Mapping[str, tuple[float, float]]  # In it
    found: Findings
    identified: Identification
    logs: tuple[Path, ...]  # Of the steps, in their order
    runs: int  # Runs made by this call

    def document(self) -> dict[str, Any]:
        """Result as plain data."""
        return {
            "result": "done",
            "bench": str(self.bench),
            "logs": [str(path) for path in self.logs],
            "runs": self.runs,
            "ranges": {name: list(pair) for name, pair in self.ranges.items()},
            "found": asdict(self.found),
        }

    def __str__(self) -> str:
        one = self.identified
        fits = (
            "the residuals do not speak against it" if one.fits else f"NO model explains the experiments{one.reasons()}"
        )
        lines = [f"done: {len(self.logs)} steps, {self.runs} runs now; model {one.model}: {fits}"]
        lines += [f"  {name:<4} {low:.5g} to {high:.5g} {one.units[name]}" for name, (low, high) in self.ranges.items()]
        return "\n".join([*lines, f"  bench file {self.bench}: each number in it says where it comes from"])


class Commissioning:
    """Commissioning in a folder.

    Args:
        folder: for bench files, policies and logs; a step that has a completed log there is not run again.
        sheet: bench file with the data sheet's ranges.
        iface: the bus.
        options: further options of ``emb-run`` for each run.
        run: makes a run.
        say: reports progress.
    """

    def __init__(
        self, folder: Path, sheet: Bench, iface: str, options: Sequence[str], run: Run, say: Callable[[str], None]
    ) -> None:
        self._folder, self._sheet, self._iface, self._options = folder, sheet, iface, options
        self._make_run, self._say = run, say
        self._logs: dict[str, Path] = {}
        self._identity = sheet.identity_hash  # of the bench that the node is set up for
        self._runs = 0

    def run(self) -> Commissioned:
        """All steps that are not done yet.

        Raises:
            EmbError: a step was refused, was stopped, or contradicts the data sheet.
        """
        work = self._bench(WORKING, working_text(self._sheet))
        found = Findings()
        while (step := next_step(self._sheet, work, found, list(self._logs))) is not None:
            bench = self._bench_of(step, work, found)
            log = self._completed(step) or self._run(step, bench, found)
            self._logs[step.name] = log
            finding = self._examine(step, log, found)
            found = judged(step, finding, self._sheet, found)
            self._say(f"  found: {finding or 'nothing to object to'}")
        one = found.identified
        assert one is not None
        ranges = measured_ranges(self._sheet, one)
        return Commissioned(self._folder / FOUND, ranges, found, one, tuple(self._logs.values()), self._runs)

    # --- files ------------------------------------------------------------------------------------------------------

    def _bench(self, name: str, text: str) -> Bench:
        """The bench file of that name, written if it is not there yet."""
        path = self._folder / name
        if path.exists():
            there = load_bench(path)
            if parse_toml(there.text) == parse_toml(text):
                return there
            is_another = there.identity_hash != parse_bench(text, name).identity_hash
            if is_another and (any(self._folder.glob("*.mcap")) or WRITTEN not in there.text):
                raise UsageError(
                    f"{path}: another bench than this data sheet's or these logs', which rest on it; go on with the "
                    "data sheet that it was made from, or take another folder for this one"
                )
        try:
            path.write_text(text, encoding="utf-8")
        except OSError as err:
            raise UsageError(f"{path}: cannot write the bench file: {err.strerror}") from err
        return load_bench(path)

    def _bench_of(self, step: Step, work: Bench, found: Findings) -> Bench:
        if step.final:
            used = " and ".join(path.name for path in self._experiments())
            logs = {"rest": self._logs["1-listen"].name, "current": self._logs["3-current"].name, "experiments": used}
            return self._bench(FOUND, found_text(self._sheet, found, logs))
        return self._bench(LEARNING_FILE, working_text(self._sheet, learns=True)) if step.learns else work

    def _experiments(self) -> list[Path]:
        """Logs of the latest experiments with the data sheet's ranges."""
        return [self._logs[name] for name, *_ in WIDENING if name in self._logs][-RECENT:]

    def _attempts(self, step: Step) -> list[Path]:
        names = [step.name, *(f"{step.name}-attempt{number}" for number in range(2, MOST_ATTEMPTS))]
        return [self._folder / f"{name}.mcap" for name in names]

    def _completed(self, step: Step) -> Path | None:
        """The log of a step that was completed before."""
        there = [path for path in self._attempts(step) if path.exists()]
        return next((path for path in there if examination.ended(path) == "DONE"), None)

    # --- runs -------------------------------------------------------------------------------------------------------

    def _run(self, step: Step, bench: Bench, found: Findings) -> Path:
        self._say(f"{step.name}: {step.purpose}\n  relies on {step.rests_on}")
        path = self._folder / (FOUND if step.final else LEARNING_FILE if step.learns else WORKING)
        if bench.identity_hash != self._identity:
            self._identity = bench.identity_hash
            identity = bench_identity(bench.identity_hash)
            self._say(f"  the node has to be set up for {path}, bench identity {identity:#06x}")
        policy = self._folder / f"{step.name}.onnx"
        policy.write_bytes(policy_file(step, bench))
        log = next(path for path in self._attempts(step) if not path.exists())
        arguments = ["--iface", simulated(self._iface, self._sheet, self._runs), "--bench", str(path)]
        arguments += ["--policy", str(policy), "--log", str(log), "--duration", repr(step.duration)]
        self._runs += 1
        document = self._make_run([*arguments, *self._options, *_stage(step), "--json"])
        if document["exit_code"] == EXIT_DONE and examination.ended(log) == "DONE":
            return log
        why, is_outside = _failure(document)
        advice = f"see {log}, and begin again in the same folder once the cause is removed"
        raise StepFailedError(
            f"step {step.name} was not completed: {why}; {suspected(self._sheet, found) if is_outside else advice}",
            document["exit_code"] or EXIT_SAFETY_STOP,
        )

    def _examine(self, step: Step, log: Path, found: Findings) -> object:
        match step.kind:
            case Kind.REST:
                return examination.at_rest(log)
            case Kind.CURRENT:
                return examination.current(log)
            case Kind.CHAIN:
                return None
        assert found.rest is not None
        if step.kind is Kind.FIRST_MOVE:
            return examination.first_move(log, found.rest.noise)
        logs = [log] if step.final else self._experiments()
        return examination.identify(logs, self._sheet, found.rest.noise, found.identified)


def emb_run(arguments: Sequence[str]) -> Mapping[str, Any]:
    """Run ``emb-run`` as a process of its own, at the operator's terminal; signals that end this one end that one.

    Raises:
        StepFailedError: it printed no document; it has said why.
    """
    code = "import sys; from emb_runtime.system.entry import emb_run; sys.exit(emb_run())"
    before = {number: signal.getsignal(number) for number in terminal.ENDING}
    process = subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, text=True)
    ended: list[int] = []

    def end(number: int, _frame: object) -> None:
        ended.append(number)
        process.send_signal(number)

    try:
        for number, handler in before.items():
            if handler is not signal.SIG_IGN:
                signal.signal(number, end)
        printed = process.communicate()[0]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if not printed.strip():
        raise StepFailedError("emb-run ended without a result", max(process.returncode, EXIT_SAFETY_STOP))
    document: dict[str, Any] = json.loads(printed)
    if ended and document["result"] == "done":
        raise SafetyStopError("stopped by the operator after a run; the same command goes on from there")
    return {**document, "exit_code": process.returncode}


def simulated(iface: str, sheet: Bench, run: int) -> str:
    """A simulated brake that stays the same when the bench file changes, with noise of its own in each run.

    Any other bus stays as it is.
    """
    head, at, bus = iface.rpartition("@")  # what lies before it is a drive's mapping
    name, _, options = bus.partition(":")
    if name not in SIMULATED:
        return iface
    given = [option.strip() for option in options.split(",") if option.strip()]
    named = {key.strip(): value.strip() for key, _, value in (option.partition("=") for option in given)}
    own = {parameter: getattr(sheet.brake, parameter) for parameter in PARAMETER_NAMES}
    own |= {"angle_noise": sheet.noise.angle, "velocity_noise": sheet.noise.velocity}
    given += [f"{key}={value!r}" for key, value in own.items() if key not in named]
    seed = named.get("seed", "1")
    if run and seed.isdecimal():
        given = [option for option in given if not option.startswith("seed")] + [f"seed={int(seed) + run}"]
    return f"{head}{at}{name}:{','.join(given)}"


def _stage(step: Step) -> list[str]:
    if step.kind is Kind.REST:
        return ["--read-only"]
    if step.limit == 0.0:
        return ["--zero"]
    # No way home with a current whose sign and scale are not known yet.
    return ["--limit", repr(step.limit), *(["--home"] if step.kind is not Kind.CURRENT else [])]


def _failure(document: Mapping[str, Any]) -> tuple[str, bool]:
    """Words for why a run, or a way home before or after it, was not completed; True if no brake of the set does so."""
    ways = {f"way home {when} it: ": way for when, way in document.get("homing", {}).items()}
    for name, one in {"": document, **ways}.items():
        if one["result"] != "done":
            return f"{name}{one['result']}: {one['detail'] or one['cause']}", one["result"] in OUTSIDE
    return "it was ended before its time", False


GRAPH = """
<ir_version: 10, opset_import: ["" : 20]>
commissioning (float[1, 3] inputs) => (float[1, 1] outputs)
<
  float[1] lowest = {{{lowest}}}, float[1] highest = {{{highest}}}, float[1] fastest = {{{speed}}},
  float[1] slowest = {{-{speed}}}, float[1] least = {{{least}}}, float[1] most = {{{most}}}, float[1] zero = {{0}},
  float[1] rate = {{{rate}}},
  float[{count}] currents = {{{currents}}},
  int64[1] first = {{0}}, int64[1] second = {{1}}, int64[1] third = {{2}}, int64 begin = {{0}}, int64 last = {{{last}}}
>
{{
  angle = Gather <axis = 1> (inputs, first)
  velocity = Gather <axis = 1> (inputs, second)
  time = Gather <axis = 1> (inputs, third)
  step = Mul (time, rate)
  whole = Round (step)
  number = Cast <to = 7> (whole)
  place = Clip (number, begin, last)
  wanted = Gather <axis = 0> (currents, place)
  above = Greater (angle, highest)
  fast_up = Greater (velocity, fastest)
  no_more_up = Or (above, fast_up)
  upper = Where (no_more_up, zero, most)
  below = Less (angle, lowest)
  fast_down = Less (velocity, slowest)
  no_more_down = Or (below, fast_down)
  lower = Where (no_more_down, zero, least)
  raised = Max (wanted, lower)
  outputs = Min (raised, upper)
}}
"""
"""The current of the step, cut to zero on the side that leads out of the window."""


def policy_file(step: Step, bench: Bench) -> bytes:
    """The policy of a step, for a bench: its current, but none that drives the brake farther out of the window."""
    currents = np.asarray(step.currents or (0.0,), np.float32)
    limit, window = bench.limits.current, step.window
    text = GRAPH.format(
        lowest=window.lowest,
        highest=window.highest,
        speed=window.speed,
        rate=1.0 / bench.timing.sample_time,
        least=-limit,
        most=limit,
        count=len(currents),
        currents=_numbers(currents.tolist()),
        last=len(currents) - 1,
    )
    model = onnx.parser.parse_model(text)
    model.metadata_props.add(key=CONTRACT_KEY, value=_contract(currents.tolist(), step, bench).to_json())
    return model.SerializeToString()


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.9g}" for value in values)  # nine digits tell single precision exactly


def _contract(currents: list[float], step: Step, bench: Bench) -> Contract:
    places = [k * (len(currents) - 1) // (MIN_VECTORS - 1) for k in range(MIN_VECTORS)]
    return Contract(
        kind="current",
        inputs=SAMPLE,
        limits=PolicyLimits(bench.limits.current, bench.limits.angle, bench.limits.velocity),
        sample_time=bench.timing.sample_time,
        horizon=bench.timing.horizon,
        vectors=tuple(Vector((0.0, 0.0, k * bench.timing.sample_time), (currents[k],)) for k in places),
        provenance={"commissioning": step.name},
    )
