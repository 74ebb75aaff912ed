"""``emb-run --commission``: from a data sheet to a bench file, by ordinary runs that each rest on those before."""

from __future__ import annotations

import argparse
import importlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, cast

from emb_runtime.can.interfaces import open_transport
from emb_runtime.can.messages import bench_identity
from emb_runtime.can.transport import is_private
from emb_runtime.cli import listen_only
from emb_runtime.cli.options import Plan, parser, prepare
from emb_runtime.cli.preflight import interrupted
from emb_runtime.cli.repeat import experiment, with_next_seed
from emb_runtime.cli.session import Bus, Console
from emb_runtime.commission.bench_file import WRITTEN, Findings, found_text, measured_ranges, working_text
from emb_runtime.commission.excitation import policy_file
from emb_runtime.commission.records import (
    CurrentCheck,
    Examiner,
    FirstMove,
    Identification,
    Kind,
    Rest,
    Step,
)
from emb_runtime.commission.steps import WIDENING, judged, next_step, suspected
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, Noise, load_bench, parse_bench
from emb_runtime.config.toml_text import parse_toml
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.errors import EXIT_DONE, SafetyStopError, UsageError
from emb_runtime.safety.state_machine import Fault
from emb_runtime.system.terminal import as_json, mention, show

ENTRY_POINTS = "emb_runtime.examiners"
"""Entry-point group of what reads the logs of a commissioning, under the name ``logs``."""
WORKING, LEARNING_FILE, FOUND = "working.toml", "working-learning.toml", "bench.toml"
"""Names of the bench files in the folder."""
RECENT = 2  # Experiments that the parameters are estimated from: each is larger and says more than those before it
MOST_ATTEMPTS = 100  # Logs of one step
OUTSIDE = {Fault.OUT_OF_LIMITS.name, Fault.MOTION_OUTSIDE_SET.name, Fault.SET_CONTRADICTED.name}
"""Results by which the brake may lie outside of the data sheet's ranges."""
WHILE_EXAMINED = "while logs were examined; the same command goes on from there"
LOOK = 0.1  # Time between two looks at the operator's end while logs are examined [s]


@dataclass(frozen=True)
class Commissioned:
    """Result of a commissioning."""

    bench: Path | None  # The file that was found; None where it ended before
    found: Findings
    logs: tuple[Path, ...]  # Of the steps that were completed, in their order
    runs: int  # Runs that were made, those that were completed before not counted


class Commissioning:
    """Commissioning in a folder.

    Args:
        folder: for its bench files, policies and logs; what is in it is gone on with.
        sheet: bench file with the data sheet's ranges.
        iface: the bus.
        options: further options of ``emb-run`` for each run.
        examiner: reads the logs.
        console: makes the operator of each run.
        say: reports progress.
    """

    def __init__(
        self,
        folder: Path,
        sheet: Bench,
        iface: str,
        options: tuple[str, ...],
        examiner: Examiner,
        console: Callable[[Plan], Console],
        say: Callable[[str], None],
    ) -> None:
        self._folder, self._sheet, self._options = folder, sheet, options
        self._iface, self._asks = _pinned(iface, sheet), _asks(iface)
        self._examiner, self._console, self._say = examiner, console, say
        self._logs: dict[str, Path] = {}
        self._identity = sheet.contract_hash  # of the bench that the node is set up for
        self._truth: dict[str, str] = {}  # of a simulated bus
        self._runs = 0

    def run(self) -> Commissioned:
        """All steps that are not done yet.

        Raises:
            EmbError: a step was refused, was stopped, or contradicts the data sheet.
        """
        work = self._bench(WORKING, working_text(self._sheet))
        found, written = Findings(), None
        while (step := next_step(self._sheet, work, found, list(self._logs), asks=self._asks)) is not None:
            if step.final:
                written = self._write(found)
            bench = self._bench_of(step, work)
            log = self._completed(step)
            if log is None:
                log = self._run(step, bench, found)
            self._logs[step.name] = log
            finding = self._examine(step, log, found)
            found = judged(step, finding, self._sheet, found)
            self._say(f"  found: {_words(finding)}")
        return Commissioned(written, found, tuple(self._logs.values()), self._runs)

    # --- files ------------------------------------------------------------------------------------------------------

    def _bench(self, name: str, text: str) -> Bench:
        """The bench file of that name, written if it is not there yet."""
        path = self._folder / name
        if path.exists():
            there = load_bench(path)
            if parse_toml(there.text) == parse_toml(text):
                return there
            is_another = there.contract_hash != parse_bench(text, name).contract_hash
            if is_another and (any(self._folder.glob("*.mcap")) or not there.text.startswith(WRITTEN)):
                raise UsageError(
                    f"{path}: another bench than this data sheet's or these logs', which rest on it; go on with the "
                    "data sheet that it was made from, or take another folder for this one"
                )
            path.unlink()
        _write(path, text)
        return load_bench(path)

    def _bench_of(self, step: Step, work: Bench) -> Path:
        if step.final:
            return self._folder / FOUND
        if step.learns:
            self._bench(LEARNING_FILE, working_text(self._sheet, learns=True))
            return self._folder / LEARNING_FILE
        return self._folder / WORKING

    def _write(self, found: Findings) -> Path:
        names = {name: path.name for name, path in self._logs.items()}
        experiments = [path.name for path in self._experiments()[-RECENT:]]
        logs = {
            "rest": names["1-listen"],
            "current": names["3-current"],
            "experiments": f"{' and '.join(experiments)}",
        }
        self._bench(FOUND, found_text(self._sheet, found, logs))
        return self._folder / FOUND

    def _experiments(self) -> list[Path]:
        steps = [name for name, *_ in WIDENING]
        return [path for name, path in self._logs.items() if name in steps]

    def _attempts(self, step: Step) -> list[Path]:
        names = [step.name, *(f"{step.name}-attempt{number}" for number in range(2, MOST_ATTEMPTS))]
        return [self._folder / f"{name}.mcap" for name in names]

    def _completed(self, step: Step) -> Path | None:
        """The log of a step that was completed before."""
        there = [path for path in self._attempts(step) if path.exists()]
        return next((path for path in there if self._examiner.ended(path) == "DONE"), None)

    # --- runs -------------------------------------------------------------------------------------------------------

    def _run(self, step: Step, bench: Path, found: Findings) -> Path:
        self._say(f"{step.name}: {step.purpose}\n  relies on {step.rests_on}")
        if (identity := load_bench(bench).contract_hash) != self._identity:
            self._identity = identity
            self._say(f"  the node has to be set up for {bench}, bench identity {bench_identity(identity):#06x}")
        policy = self._folder / f"{step.name}.onnx"
        policy.write_bytes(policy_file(step, load_bench(bench)))
        log = next(path for path in self._attempts(step) if not path.exists())
        arguments = ["--iface", self._iface, "--bench", str(bench), "--policy", str(policy), "--log", str(log)]
        arguments += ["--duration", repr(step.duration), *self._options, *_stage(step)]
        plan = prepare(parser().parse_args(arguments))
        self._runs += 1
        document = self._listen(plan, log) if step.kind is Kind.REST and not step.asks else self._experiment(plan, log)
        if document["exit_code"] != EXIT_DONE or self._examiner.ended(log) != "DONE":
            why, is_outside = _failure(document)
            if is_outside:
                raise SafetyStopError(f"step {step.name} was not completed: {why}; {suspected(self._sheet, found)}")
            raise SafetyStopError(
                f"step {step.name} was not completed: {why}; "
                f"see {log}, and begin again in the same folder once the cause is removed"
            )
        self._iface = with_next_seed(self._iface, self._truth)
        return log

    def _listen(self, plan: Plan, log: Path) -> dict[str, Any]:
        transport, clock = open_transport(plan.iface, plan.bench)
        self._truth = {name: str(value) for name, value in (transport.truth or {}).items()}
        try:
            read = listen_only.read(plan, Bus(plan.iface, transport, clock), log, self._console(plan))
        finally:
            transport.close()
        return listen_only.document(plan, plan.iface, read)

    def _experiment(self, plan: Plan, log: Path) -> dict[str, Any]:
        done = experiment(plan, plan.iface, log, self._console(plan))
        self._truth = done.truth
        return {**done.document, "exit_code": done.exit_code}

    def _examine(self, step: Step, log: Path, found: Findings) -> object:
        match step.kind:
            case Kind.REST:
                return self._examiner.rest(log)
            case Kind.CURRENT:
                return self._examiner.current(log)
            case Kind.FIRST_MOVE:
                assert found.rest is not None
                return self._examiner.first_move(log, found.rest.noise)
            case Kind.EXPERIMENT:
                assert found.rest is not None
                logs = [log] if step.final else self._experiments()[-RECENT:]
                return self._examiner.identify(logs, self._sheet, found.rest.noise, found.identified)
        return None


class ExaminerProcess:
    """The examiner that is installed, in a process of its own: its libraries do not share the loop's processor time.

    Args:
        stop_requested: whether an end is wanted, which need not wait for an estimate.

    Raises:
        UsageError: none is installed.
    """

    def __init__(self, stop_requested: Callable[[], bool]) -> None:
        entries = list(metadata.entry_points(group=ENTRY_POINTS, name="logs"))
        if not entries:
            raise UsageError(
                "--commission: nothing is installed that estimates from logs; emb_bench does: "
                "pip install 'emb-excite[bench]'"
            )
        self._place = entries[0].value
        self._stop_requested = stop_requested
        self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin_examining)
        self._process = self._pool.submit(os.getpid)

    def close(self) -> None:
        """End the process."""
        self._pool.shutdown()

    def ended(self, log: Path) -> str:
        """Reason why a run ended."""
        return cast(str, self._ask("ended", log))

    def rest(self, log: Path) -> Rest:
        """Findings of a listen-only log."""
        return cast(Rest, self._ask("rest", log))

    def current(self, log: Path) -> CurrentCheck:
        """Findings about the current."""
        return cast(CurrentCheck, self._ask("current", log))

    def first_move(self, log: Path, noise: Noise) -> FirstMove:
        """Findings of the first move."""
        return cast(FirstMove, self._ask("first_move", log, noise))

    def identify(
        self, logs: Sequence[Path], sheet: Bench, noise: Noise, before: Identification | None
    ) -> Identification:
        """Parameters from experiments."""
        return cast(Identification, self._ask("identify", logs, sheet, noise, before))

    def _ask(self, question: str, *arguments: Any) -> object:
        try:
            answer = self._pool.submit(_examine, self._place, question, arguments)
            while not wait([answer], LOOK).done:
                if self._stop_requested():
                    os.kill(self._process.result(), signal.SIGTERM)
                    raise interrupted(WHILE_EXAMINED)
            return answer.result()
        except BrokenProcessPool as err:
            if self._stop_requested():  # what was for the run, such as a terminal that was closed, has ended it as well
                raise interrupted(WHILE_EXAMINED) from None
            raise UsageError(f"--commission: the process that estimates has ended: {err}") from err
        except ImportError as err:
            raise UsageError(f"--commission: {err}; pip install 'emb-excite[bench]'") from err


def _examine(place: str, question: str, arguments: tuple[Any, ...]) -> object:
    module, _, name = place.partition(":")
    return getattr(getattr(importlib.import_module(module), name)(), question)(*arguments)


def _begin_examining() -> None:
    """Ignore the operator's Ctrl-C, which is for the run, and end with the process of the run."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def commission(args: argparse.Namespace, console: Callable[[Plan], Console], stop_requested: Callable[[], bool]) -> int:
    """``--commission``; the exit code.

    Args:
        args: of the command line.
        console: makes the operator of each run.
        stop_requested: whether an end is wanted.

    Raises:
        EmbError: an argument does not go with it, or a step was refused, was stopped, or contradicts the data sheet.
    """
    if given := [option for option, is_given in _taken(args).items() if is_given]:
        raise UsageError(f"--commission: chooses {', '.join(given)} by itself, step by step")
    sheet = load_bench(args.bench)
    folder: Path = args.commission
    examiner = ExaminerProcess(stop_requested)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        whole = Commissioning(folder, sheet, args.iface, _options(args), examiner, console, mention)
        result = whole.run()
    except OSError as err:
        raise UsageError(f"--commission {folder}: {err.strerror}; expected a folder, made if there is none") from err
    finally:
        examiner.close()
    show(as_json(document(result, sheet)) if args.json else text(result, sheet))
    return EXIT_DONE


def document(result: Commissioned, sheet: Bench) -> dict[str, Any]:
    """Result as plain data."""
    one = result.found.identified
    assert one is not None
    return {
        "result": "done",
        "bench": str(result.bench),
        "logs": [str(path) for path in result.logs],
        "runs": result.runs,
        "ranges": {name: list(pair) for name, pair in measured_ranges(sheet, one).items()},
        "found": asdict(result.found),
    }


def text(result: Commissioned, sheet: Bench) -> str:
    """Result for a person."""
    one = result.found.identified
    assert one is not None
    fits = "the residuals do not speak against it" if one.fits else f"NO model explains the experiments{_why(one)}"
    lines = [f"done: {len(result.logs)} steps, {result.runs} runs now; model {one.model}: {fits}"]
    ranges = measured_ranges(sheet, one).items()
    lines += [f"  {name:<4} {low:.5g} to {high:.5g} {one.units[name]}" for name, (low, high) in ranges]
    return "\n".join([*lines, f"  bench file {result.bench}: each number in it says where it comes from"])


def _taken(args: argparse.Namespace) -> dict[str, bool]:
    """Options that a commissioning chooses by itself, and whether they were given."""
    return {
        "--policy": args.policy is not None,
        "--quick": args.quick,
        "--duration": args.duration is not None,
        "--stop-when": args.stop_when is not None,
        "--live": args.live is not None,
        "--read-only": args.read_only,
        "--zero": args.zero,
        "--limit": args.limit is not None,
        "--home": args.home,
        "--repeat": args.repeat != 1,
        "--log": args.log != parser().get_default("log"),
    }


def _options(args: argparse.Namespace) -> tuple[str, ...]:
    """Options of each run. On a real bus each one is confirmed."""
    found = [name for name in ("no_rt", "no_watchdog", "long_timeouts") if getattr(args, name)]
    options = [f"--{name.replace('_', '-')}" for name in found]
    for name in ("operator", "serial", "cpu"):
        if getattr(args, name) not in (None, ""):
            options += [f"--{name}", str(getattr(args, name))]
    if args.yes:
        options.append("--yes")
    elif args.confirm or not _is_in_process(args.iface):
        options.append("--confirm")
    return tuple(options)


def _is_in_process(iface: str) -> bool:
    """True if nobody but this process can be on a bus; an interface of the kernel may be called anything."""
    bus = iface.rpartition("@")[2] if iface.startswith("map:") else iface
    return bus.partition(":")[0] in ("sim", "sim-drive") or is_private(bus)


def _asks(iface: str) -> bool:
    """True for a mapped drive that speaks only when it is spoken to."""
    name, _, options = iface.partition(":")
    return name == "map" and bool(options) and load_mapping(Path(options.rpartition("@")[0])).polled


def _pinned(iface: str, sheet: Bench) -> str:
    """A simulated brake that stays the same when the bench file changes; any other bus as it is."""
    head, at, bus = iface.partition("@")  # what lies before it is a drive's mapping
    if at:
        return f"{head}@{_pinned(bus, sheet)}"
    name, _, options = iface.partition(":")
    if name not in ("sim", "sim-drive"):
        return iface
    given = [option.strip() for option in options.split(",") if option.strip()]
    named = {option.partition("=")[0].strip() for option in given}
    own = {parameter: getattr(sheet.brake, parameter) for parameter in PARAMETER_NAMES}
    own |= {"angle_noise": sheet.noise.angle, "velocity_noise": sheet.noise.velocity}
    given += [f"{key}={value!r}" for key, value in own.items() if key not in named]
    return f"{name}:{','.join(given)}"


def _words(finding: object) -> str:
    """A finding in a line."""
    match finding:
        case Rest():
            return (
                f"noise {finding.noise.angle:.3g} rad and {finding.noise.velocity:.3g} rad/s, a sample each "
                f"{1e3 * finding.period:.6g} ms, jitter {1e6 * finding.jitter:.3f} us"
            )
        case CurrentCheck():
            return (
                f"commands {finding.delay} samples late, current times {finding.scale:.4f}, error {finding.error:.2g} A"
            )
        case FirstMove():
            return f"moves at {finding.up:.3f} A and {-finding.down:.3f} A, angle over velocity {finding.scale:.3f}"
        case Identification():
            values = ", ".join(_within(finding, name) for name in finding.intervals)
            fits = "" if finding.fits else f", which does not fit yet{_why(finding)}"
            return f"at 95 % {values}; model {finding.model}{fits}"
    return "nothing to object to"


def _why(one: Identification) -> str:
    return f" ({'; '.join(one.objections)})" if one.objections else ""


def _within(one: Identification, name: str) -> str:
    value, (low, high) = one.values[name], one.intervals[name]
    aside = max(high - value, value - low) / abs(value)
    return f"{name} {value:.5g} {one.units[name]} ± {100.0 * aside:.2g} %"


def _failure(document: Mapping[str, Any]) -> tuple[str, bool]:
    """Words for why a run, or a way home before or after it, was not completed; True if no brake of the set does so."""
    ways = {f"way home {when} it": way for when, way in document.get("homing", {}).items()}
    for name, one in {"": document, **ways}.items():
        if one["result"] != "done":
            why = f"{name}: {one['result']}: {one['detail'] or one['cause']}".removeprefix(": ")
            return why, one["result"] in OUTSIDE
    return "it was ended before its time", False


def _stage(step: Step) -> list[str]:
    if step.kind is Kind.REST and not step.asks:
        return ["--read-only"]
    if step.limit == 0.0:
        return ["--zero"]
    # No way home with a current whose sign and scale are not known yet.
    return ["--limit", repr(step.limit), *(["--home"] if step.kind is not Kind.CURRENT else [])]


def _write(path: Path, text: str) -> None:
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as err:
        raise UsageError(f"{path}: cannot write the bench file: {err.strerror}") from err
