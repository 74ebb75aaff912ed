"""Commissioning in a folder: a run of ``emb-run`` for each step, whose log is examined before the next one."""

from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from emb_bench.brake.parameters import SI
from emb_bench.commission import comparison, examination, steps
from emb_bench.commission.bench_file import WRITTEN, found_text, working_text
from emb_bench.commission.records import Findings, Identification
from emb_bench.commission.steps import EXPERIMENTS, Step, policy_file
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
"""Names of the bench files in the folder: up to the free stroke, once the velocity is known, and in the end."""
RECENT = 2  # Experiments that the parameters are estimated from: each is larger and tells more than those before it
OUTSIDE = {Fault.OUT_OF_LIMITS.name, Fault.MOTION_OUTSIDE_SET.name}
"""Results by which the brake may lie outside of the data sheet's ranges."""
SIMULATED = ("sim", "sim-drive")  # Buses whose brake is made anew for each run

Run = Callable[[Sequence[str]], Mapping[str, Any]]
"""A run of ``emb-run --json`` with these arguments; the document that it prints."""
Finding = TypeVar("Finding")


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
        self._logs: list[RunLog] = []
        self._identified: Identification | None = None
        self._identity = sheet.identity_hash  # of the bench that the node is set up for
        self._runs = 0

    def run(self) -> Commissioned:
        """All steps that are not done yet.

        Raises:
            UsageError: the folder is another brake's, or a file cannot be written.
            StepFailedError: a run was not completed.
            SafetyStopError: a step contradicts the data sheet.
            BenchFileError: no shield covers the data sheet, or a parameter lies outside of it.
        """
        sheet, working = self._sheet, self._bench_file(WORKING, working_text(self._sheet))
        work = load_bench(working)
        noise = examination.noise_at_rest(self._log("1-listen", steps.LISTEN, working), sheet)
        self._say(f"  found: noise {plain(noise.angle)} rad and {plain(noise.velocity)} rad/s")
        comparison.check_noise(noise, sheet)
        self._log("2-zero", steps.ZERO, working)
        self._say("  found: no fault")
        current = self._found(examination.current(self._log("3-current", steps.current_check(work), working)))
        comparison.check_current(current, sheet)
        log = self._log("4-first-move", steps.first_move(work), working)
        move = self._found(examination.first_move(log, noise))
        comparison.check_first_move(move, sheet)
        for name, row in EXPERIMENTS.items():
            self._log(name, steps.experiment(row, work, move), working)
            recent, before = self._logs[4:][-RECENT:], self._identified
            one = self._found(examination.identify(recent, sheet, noise, before))
            comparison.check_velocity(one.velocity, work.sensors)
            known = one.velocity.sensors
            if before is None and (known.bandwidth or math.inf) > (work.sensors.bandwidth or math.inf):
                working = self._bench_file(FASTER, working_text(sheet, one.velocity))
                work = load_bench(working)
            comparison.check_experiment(one, sheet, is_first=before is None)
            self._identified = one
        found = Findings(noise, current, move, one)
        path = self._bench_file(FOUND, found_text(sheet, found, " and ".join(log.path.name for log in recent)))
        bench = load_bench(path)
        log = self._log("9-full", steps.experiment(steps.FULL, bench, move), path)
        comparison.check_last(self._found(examination.identify([log], sheet, noise, one)), bench)
        ranges = {name: comparison.sheet_range(bench, name) for name in PARAMETER_NAMES}
        return Commissioned(path, ranges, found, tuple(log.path for log in self._logs), self._runs)

    def _found(self, finding: Finding) -> Finding:
        self._say(f"  found: {finding}")
        return finding

    def _bench_file(self, name: str, text: str) -> Path:
        """Write a bench file, unless logs rest on another bench of that name, or somebody else wrote it."""
        path = self._folder / name
        if path.exists():
            there = load_bench(path)
            if there.text == text:
                return path  # a full disk would empty it
            is_another = there.identity_hash != parse_bench(text, name).identity_hash
            if is_another and (any(self._folder.glob("*.mcap")) or WRITTEN not in there.text):
                raise UsageError(
                    f"{path}: another bench than this data sheet's or these logs', which rest on it; go on with the "
                    "data sheet that it was made from, or take another folder for this one"
                )
        path.write_text(text, encoding="utf-8")
        write_schemas(self._folder, "bench")
        return path

    def _log(self, name: str, step: Step, path: Path) -> RunLog:
        """The completed log of a step with a bench file: one that is there, else that of a new run."""
        file, attempts, log = self._folder / f"{name}.mcap", 1, None
        while file.exists() and (log := examination.completed(file)) is None:
            attempts += 1
            file = self._folder / f"{name}-attempt{attempts}.mcap"
        if log is None:
            log = self._run(name, step, path, file)
        self._logs.append(log)
        return log

    def _run(self, name: str, step: Step, path: Path, log: Path) -> RunLog:
        self._say(f"{name}: {step.purpose}")
        bench = load_bench(path)
        if bench.identity_hash != self._identity:
            self._identity = bench.identity_hash
            self._say(f"  set up the node for {path}, bench identity {bench_identity(bench.identity_hash):#06x}")
        policy = self._folder / f"{name}.onnx"
        policy.write_bytes(policy_file(step, bench))
        arguments = ["--iface", simulated(self._iface, self._sheet, self._runs), "--bench", str(path)]
        arguments += ["--policy", str(policy), "--log", str(log), "--duration", repr(step.duration)]
        self._runs += 1
        document = self._make_run([*arguments, *self._options, *step.stage, "--json"])
        if document["exit_code"] == EXIT_DONE and (completed := examination.completed(log)) is not None:
            return completed
        why, is_outside = _failure(document)
        advice = f"see {log}, and begin again in the same folder once the cause is removed"
        if is_outside:  # no brake of the set moves so
            advice = comparison.suspected(self._sheet, self._identified)
        raise StepFailedError(
            f"step {name} was not completed: {why}; {advice}", document["exit_code"] or EXIT_SAFETY_STOP
        )


def emb_run(arguments: Sequence[str]) -> Mapping[str, Any]:
    """Run ``emb-run`` as a process of its own, at the operator's terminal; signals that end this one end that one."""
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
        raise SafetyStopError("stopped by the operator before a run; the same command goes on from there")
    if not printed.strip():
        exit_code = process.returncode if process.returncode > 0 else EXIT_SAFETY_STOP
        raise StepFailedError("emb-run ended without a result; its message is above", exit_code)
    document: dict[str, Any] = json.loads(printed)
    if ended and document["result"] == "done":
        raise SafetyStopError("stopped by the operator after a run; the same command goes on from there")
    return {**document, "exit_code": process.returncode}


def simulated(iface: str, sheet: Bench, run: int) -> str:
    """A simulated brake that stays the same when the bench file changes, with noise of its own in each run.

    Any other bus stays as it is.
    """
    head, at, bus = iface.rpartition("@")  # what lies before it is a drive's mapping
    name, _, given = bus.partition(":")
    if name not in SIMULATED:
        return iface
    own = {parameter: getattr(sheet.brake, parameter) for parameter in PARAMETER_NAMES}
    own |= {"angle_noise": sheet.noise.angle, "velocity_noise": sheet.noise.velocity, "seed": 1}
    options = ",".join([given, *(f"{key}={own[key]!r}" for key in own if not re.search(rf"\b{key} *=", given))])
    seeded = re.sub(r"\bseed *= *(\d+)", lambda seed: f"seed={int(seed[1]) + run}", options)
    return f"{head}{at}{name}:{seeded.lstrip(',')}"


def _failure(document: Mapping[str, Any]) -> tuple[str, bool]:
    """Words for why a run, or a way home before or after it, was not completed; True if no brake of the set does so."""
    ways = {f"way home {when} it: ": way for when, way in document.get("homing", {}).items()}
    for name, one in {"": document, **ways}.items():
        if one["result"] != "done":
            return f"{name}{one['result']}: {one['detail'] or one['cause']}", one["result"] in OUTSIDE
    return "it was ended before its time", False
