"""Commissioning in a folder: a run of ``emb-run`` for each step, whose log is examined before the next one."""

from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emb_bench.brake.parameters import SI
from emb_bench.commission import examination, steps
from emb_bench.commission.bench_file import WRITTEN, found_text, working_text
from emb_bench.commission.records import Findings, Identification, noise_problems, sheet_range, suspected
from emb_bench.commission.steps import EXPERIMENTS, FULL, Step, step_policy
from emb_bench.config.bench import Bench, load_bench, parse_bench
from emb_bench.logs.log import RunLog
from emb_runtime.can.messages import bench_identity
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.config.schemas import write_schemas
from emb_runtime.errors import EXIT_DONE, EXIT_SAFETY_STOP, EmbError, SafetyStopError, UsageError
from emb_runtime.numbers import between, plain
from emb_runtime.safety.state_machine import Fault
from emb_runtime.system import terminal

WORKING, FASTER, FOUND = "working.toml", "working-2.toml", "bench.toml"
"""Names of the bench files in the folder: up to the free stroke, with the velocity found there, and in the end."""
RECENT = 2  # Experiments that the parameters are estimated from: each is larger than those before it
OUTSIDE = {Fault.OUT_OF_LIMITS.name, Fault.MOTION_OUTSIDE_SET.name}
"""Results by which the brake may lie outside of the data sheet's ranges."""
SIMULATED = ("sim", "sim-drive")  # Buses whose brake is made anew for each run

Run = Callable[[Sequence[str]], Mapping[str, Any]]
"""A run of ``emb-run --json`` with these arguments; the document that it prints."""


class StepFailedError(EmbError):
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
    logs: tuple[Path, ...]  # Of the steps, in their order
    runs: int  # Runs made by this call

    def __str__(self) -> str:
        one = self.found.identified
        fits = "the residual tests accept it" if one.fits else f"NO model explains the experiments{one.reasons()}"
        lines = [f"done: {len(self.logs)} steps, {self.runs} new runs; model {one.model}: {fits}"]
        lines += [f"  {name:<4} {between(low, high)} {SI[name]}" for name, (low, high) in self.ranges.items()]
        lines.append(f"  the velocity is {one.velocity}")
        return "\n".join([*lines, f"  bench file {self.bench}: a comment behind each measured number gives its source"])


@dataclass
class Commissioning:
    """Commissioning in a folder."""

    folder: Path
    """For bench files, policies and logs; a step that has a completed log there is not run again."""
    sheet: Bench  # With the data sheet's ranges
    iface: str  # The bus
    options: Sequence[str]  # Further ones of ``emb-run`` for each run
    make_run: Run
    say: Callable[[str], None]  # Reports progress

    def __post_init__(self) -> None:
        self._bench, self._path = self.sheet, Path()  # bench file of the next run
        self._identity = self.sheet.identity_hash  # of the bench that the node is set up for
        self._logs = list[RunLog]()
        self._identified: Identification | None = None
        self._runs = 0

    def run(self) -> Commissioned:
        """All steps that are not done yet.

        Raises:
            UsageError: the folder is another brake's, or a file cannot be written.
            StepFailedError: a run was not completed.
            SafetyStopError: a step contradicts the data sheet.
            BenchFileError: no shield covers the data sheet, or a parameter lies outside of it.
        """
        sheet = self.sheet
        self._use(WORKING, working_text(sheet))
        noise = examination.noise_at_rest(self._log("1-listen", steps.LISTEN), sheet)
        words = f"noise {plain(noise.angle)} rad and {plain(noise.velocity)} rad/s"
        self._found(words, noise_problems(noise, sheet))
        self._log("2-zero", steps.ZERO)
        self._found("no fault", ())
        current = examination.current(self._log("3-current", steps.current_check(self._bench)))
        self._found(current, current.problems(sheet))
        move = examination.first_move(self._log("4-first-move", steps.first_move(self._bench)), noise)
        self._found(move, move.problems(sheet))
        for name, row in EXPERIMENTS.items():
            self._log(name, steps.experiment(row, self._bench, move))
            recent, before, declared = self._logs[4:][-RECENT:], self._identified, self._bench.sensors
            one = examination.identify(recent, sheet, noise, before)
            self._found(one, one.velocity.problems(declared))
            if before is None and (one.velocity.sensors.bandwidth or math.inf) > (declared.bandwidth or math.inf):
                self._use(FASTER, working_text(sheet, one.velocity))
            _require_none(one.problems(sheet, is_first=before is None))
            self._identified = one
        found = Findings(noise, current, move, one)
        self._use(FOUND, found_text(sheet, found, " and ".join(log.path.name for log in recent)))
        last = examination.identify([self._log("9-full", steps.experiment(FULL, self._bench, move))], sheet, noise, one)
        self._found(last, last.changes(self._bench))
        ranges = {name: sheet_range(self._bench, name) for name in PARAMETER_NAMES}
        return Commissioned(self._path, ranges, found, tuple(log.path for log in self._logs), self._runs)

    def _found(self, finding: object, problems: Iterable[EmbError]) -> None:
        self.say(f"  found: {finding}")
        _require_none(problems)

    def _use(self, name: str, text: str) -> None:
        """Write a bench file for the next runs, unless logs rest on another of that name, or somebody else wrote it."""
        self._path, self._bench = path, bench = self.folder / name, parse_bench(text, name)
        if path.exists():
            there = load_bench(path)
            if there.text == text:
                return  # a full disk would empty it
            is_another = there.identity_hash != bench.identity_hash
            if is_another and (any(self.folder.glob("*.mcap")) or WRITTEN not in there.text):
                raise UsageError(
                    f"{path}: another bench than this data sheet's or these logs', which rest on it; go on with the "
                    "data sheet that it was made from, or take another folder for this one"
                )
        path.write_text(text, encoding="utf-8")
        write_schemas(self.folder, "bench")

    def _log(self, name: str, step: Step) -> RunLog:
        """The completed log of a step: one that is there, else that of a new run."""
        file, attempts, log = self.folder / f"{name}.mcap", 1, None
        while file.exists() and (log := examination.completed(file)) is None:
            attempts += 1
            file = self.folder / f"{name}-attempt{attempts}.mcap"
        if log is None:
            log = self._run(name, step, file)
        self._logs.append(log)
        return log

    def _run(self, name: str, step: Step, log: Path) -> RunLog:
        self.say(f"{name}: {step.purpose}")
        if self._bench.identity_hash != self._identity:
            self._identity = self._bench.identity_hash
            self.say(f"  set up the node for {self._path}, bench identity {bench_identity(self._identity):#06x}")
        policy = self.folder / f"{name}.onnx"
        policy.write_bytes(step_policy(step, self._bench))
        arguments = ["--iface", simulated(self.iface, self.sheet, self._runs), "--bench", str(self._path)]
        arguments += ["--policy", str(policy), "--log", str(log), "--duration", repr(step.duration)]
        self._runs += 1
        document = self.make_run([*arguments, *self.options, *step.stage, "--json"])
        if document["exit_code"] == EXIT_DONE and (completed := examination.completed(log)) is not None:
            return completed
        why, is_outside = _failure(document)
        advice = f"see {log}, and begin again in the same folder once the cause is removed"
        if is_outside:  # no brake of the set moves so
            advice = suspected(self.sheet, self._identified)
        raise StepFailedError(
            f"step {name} was not completed: {why}; {advice}", document["exit_code"] or EXIT_SAFETY_STOP
        )


def _require_none(problems: Iterable[EmbError]) -> None:
    for problem in problems:
        raise problem


def emb_run(arguments: Sequence[str]) -> Mapping[str, Any]:
    """Run ``emb-run`` in another process, at the operator's terminal; signals that end this process end that one."""
    code = "import sys; from emb_runtime.system.entry import emb_run; sys.exit(emb_run())"
    process = subprocess.Popen([sys.executable, "-P", "-c", code, *arguments], stdout=subprocess.PIPE, text=True)
    ended: list[int] = []

    def end(number: int, _frame: object) -> None:
        ended.append(number)
        process.send_signal(number)

    before = {n: signal.signal(n, end) for n in terminal.ENDING if signal.getsignal(n) is not signal.SIG_IGN}
    try:
        printed = process.communicate()[0]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if ended and not printed.strip():
        raise SafetyStopError("stopped by the operator before a run; the same command continues from there")
    if not printed.strip():
        exit_code = process.returncode if process.returncode > 0 else EXIT_SAFETY_STOP
        raise StepFailedError("emb-run ended without a result; its message is above", exit_code)
    document: dict[str, Any] = json.loads(printed)
    if ended and document["result"] == "done":
        raise SafetyStopError("stopped by the operator after a run; the same command continues from there")
    return {**document, "exit_code": process.returncode}


def simulated(iface: str, sheet: Bench, run: int) -> str:
    """A simulated brake that stays the same when the bench file changes, with other noise in each run.

    Any other bus stays as it is.
    """
    head, at, bus = iface.rpartition("@")  # before it stands a drive's mapping
    name, _, given = bus.partition(":")
    if name not in SIMULATED:
        return iface
    nominal = {parameter: getattr(sheet.brake, parameter) for parameter in PARAMETER_NAMES}
    nominal |= {"angle_noise": sheet.noise.angle, "velocity_noise": sheet.noise.velocity, "seed": 1}
    missing = (f"{key}={value!r}" for key, value in nominal.items() if not re.search(rf"\b{key} *=", given))
    options = ",".join([given, *missing])
    seeded = re.sub(r"\bseed *= *(\d+)", lambda seed: f"seed={int(seed[1]) + run}", options)
    return f"{head}{at}{name}:{seeded.lstrip(',')}"


def _failure(document: Mapping[str, Any]) -> tuple[str, bool]:
    """Words for why a run, or a way home before or after it, was not completed; True if no brake of the set does so."""
    ways = {f"way home {when} it: ": way for when, way in document.get("homing", {}).items()}
    for name, one in {"": document, **ways}.items():
        if one["result"] != "done":
            return f"{name}{one['result']}: {one['detail'] or one['cause']}", one["result"] in OUTSIDE
    return "it was ended before its time", False
