"""The command line of ``emb-run``: what it takes, and what it makes of it before anything is opened."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from emb_runtime.can.messages import load_layout
from emb_runtime.cli.plan import Experiment, Label, MappedDrive, Output, Plan, Precautions, Stage
from emb_runtime.config.bench import CEILING_CURRENT, Bench, load_bench
from emb_runtime.control.stop_condition import StopCondition, parse_stop_condition
from emb_runtime.errors import BenchFileError, PolicyRefusedError, UsageError
from emb_runtime.estimator.estimator import estimated
from emb_runtime.policy.policy import Policy, load_policy, shipped_actor_path
from emb_runtime.policy.trial import admit_policy
from emb_runtime.safety.shield_design import make_law
from emb_runtime.system.terminal import Parser, is_interactive, one_line

LONGEST_READING = 86_400.0  # Longest ``--read-only`` [s]
LIVE_PORT = 8765  # Port that viewers propose
LONGEST_LABEL = 200  # Characters of an operator's name or a serial number
QUICK_GOAL = "1.2%"  # Repeatability of each parameter at which an experiment with ``--quick`` ends

DESCRIPTION = """\
Run one excitation experiment. emb-run reads the brake's sensors at 1 kHz over CAN, evaluates the policy, keeps the
brake inside its limits (clip, envelope shield, guard, watchdog process), and logs everything to one MCAP file. Every
exit path stops the brake safely. Before anything is armed, a pre-flight checks bus and computer, and refuses a run if
a check fails. Results go to standard output, the pre-flight and progress to standard error.
"""

EPILOG = """\
with --json:
  One document on a line: outcome, counts, pre-flight lines, and ways home. \
A pre-flight that refuses prints a document too; an earlier error prints only \
a line on standard error.

the simulated bus:
  --iface sim:KEY=VALUE,... with the keys
    k_m, k_1, T_c, f_v           true parameters of the brake, SI units (default: nominal)
    plant                        plant of the bench file (default: exact)
    seed                         seed of the sensor noise (default: 1)
    angle_noise, velocity_noise  standard deviations of the sensors [rad, rad/s] (default: the bench file's)
    charge                       1: the node also sends the integral of its current (default: 0)

exit codes:
  0  the experiment was completed, and its log is complete; with --read-only: the node is ready
  1  with --read-only: too many samples of the node are missing
  2  usage: wrong argument, unreadable file, bench file refused, log cannot be written
  3  safety stop: a fault, Ctrl-C or SIGTERM ended the run; stop frames were sent unless nothing had been sent before
  4  bus: the interface cannot be opened, was lost, or no node is on it
  5  the policy was refused: damaged, or made for another bench
  6  the experiment was completed, but its log is not complete (disk full, recorder killed)
  8  no single brake explains what the node reported: a sensor, its zero, the reported current, or the drive is wrong
  9  with --strict: the experiment was completed, but the estimate lies outside the ranges of the bench file: the \
limits were not guaranteed

examples:
  emb-run --iface sim --json
      the shipped policy on the simulated brake, in lock-step
  emb-run --iface sim:seed=3,f_v=4e-5
      another brake, other noise
  emb-run --iface sim:plant=stribeck
      one of the plants in the bench file (--write-bench shows them)
  emb-run --iface can0 --read-only --duration 10
      first contact with a bench: what is on the bus
  emb-run --iface can0 --zero
      second: the whole chain, but 0 A
  emb-run --iface can0 --limit 1 --home
      third: at most 1 A, and back to the origin afterwards
  emb-run --iface can0 --quick
      all four parameters in a tenth of a second
  emb-run --quick --stop-when k_1=1%,f_v=5%
      ends when these two are precise enough
  emb-hil --slow 100 -- sh -c 'emb-node --iface vcan0 & emb-run --iface vcan0'
      where the kernel has no CAN
"""


def _place(text: str) -> Path:
    if not text:  # as of a variable that is not set: Path would take it for this folder
        raise argparse.ArgumentTypeError("expected a file or a folder, got an empty name")
    return Path(text)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = Parser(
        prog="emb-run",
        usage="emb-run [--iface NAME] [--policy FILE] [--bench FILE] [--log FILE|DIR]\n               [OPTION ...]",
        description=DESCRIPTION,
        epilog=EPILOG,
    )
    # fmt: off
    what = p.add_argument_group("what is run")
    what.add_argument("--iface", default="sim", metavar="NAME",
        help="SocketCAN interface (can0, vcan0), or 'sim' (lock-step, no CAN needed; the default)")
    what.add_argument("--drive", metavar="FILE@BUS",
        help="the node is an emb-gateway with this mapping file; the pre-flight lists missing properties of the drive, "
        "and the log also records the drive's bus, to which emb-run sends nothing")
    actor = what.add_mutually_exclusive_group()
    actor.add_argument("--policy", type=Path, metavar="FILE",
        help="policy as ONNX file with its contract (default: the shipped one)")
    actor.add_argument("--quick", action="store_true",
        help="use the shipped policy for a short experiment: it returns home and ends when all four parameters have "
        f"a repeatability of {QUICK_GOAL}%, or that of --stop-when (the total also includes the error of J)")
    what.add_argument("--bench", type=Path, metavar="FILE", help="bench file (default: the shipped drum brake)")
    what.add_argument("--log", type=_place, default=Path("runs"), metavar="FILE|DIR",
        help="MCAP file to write (a name with a suffix), or a folder for a file named after the time (default: runs/)")
    what.add_argument("--duration", type=float, metavar="S",
        help="shorter experiment [s] (default: the policy's horizon); with --read-only, how long to listen")
    what.add_argument("--stop-when", metavar="NAME=P%[,...]",
        help="return home and end early when the repeatability of the running estimate is below these "
        "shares of its values: k_1=1%%,f_v=5%%")
    what.add_argument("--live", nargs="?", type=int, const=LIVE_PORT, metavar="PORT",
        help="show the run while it goes on, from another process: to browsers, Foxglove and Lichtblick at "
        f"this port (default: {LIVE_PORT}; needs the extra [live]). On a terminal the page stays after the run, until "
        "Ctrl-C")
    what.add_argument("--open", action="store_true", help="open the page of --live in the browser")
    what.add_argument("--report", type=Path, metavar="FILE.html",
        help="after the run, estimate the parameters and write the page, as emb-replay report does (needs the "
        "extra [bench])")
    what.add_argument("--strict", action="store_true",
        help="exit code 9 if the estimate lies outside the ranges of the bench file, for which the limits hold")
    what.add_argument("--operator", default="", metavar="NAME", help="name of the operator, for the log and its report")
    what.add_argument("--serial", default="", metavar="TEXT", help="serial number of the device, for the log")
    output = what.add_mutually_exclusive_group()
    output.add_argument("--json", action="store_true", help="print the summary as JSON")
    output.add_argument("-v", "--verbose", action="store_true",
        help="print every check of the pre-flight and every count")
    output.add_argument("-q", "--quiet", action="store_true", help="print the verdict only")
    what.add_argument("--home", action="store_true",
        help="bring the brake to the origin before and after the experiment; each way home is guarded like a run and "
        "has a log, ...-home.mcap")

    stage = p.add_argument_group("stage: how much of the chain may act (default: all of it)")
    one = stage.add_mutually_exclusive_group()
    one.add_argument("--read-only", dest="stage", action="store_const", const=Stage.READ_ONLY,
        help="only listen, log, and list the traffic on the bus")
    one.add_argument("--zero", dest="stage", action="store_const", const=Stage.ZERO,
        help="the whole chain, but only 0 A is sent")
    one.add_argument("--limit", type=float, metavar="A",
        help="send at most this current [A]; if the shield needs more, the node brakes by itself")
    asking = stage.add_mutually_exclusive_group()
    asking.add_argument("--confirm", action="store_true", default=None,
        help="show the pre-flight and ask before anything is armed (default where the bus is real and standard input "
        "is a terminal)")
    asking.add_argument("--yes", dest="confirm", action="store_false", default=None, help="do not ask")

    machine = p.add_argument_group("real time")
    machine.add_argument("--no-rt", dest="real_time", action="store_false",
        help="do not change scheduling and memory locking")
    machine.add_argument("--no-watchdog", dest="watchdog", action="store_false",
        help="no watchdog process: for a bus without a brake")
    machine.add_argument("--long-timeouts", action="store_true",
        help="accept longer time-outs of the bench file than the shipped ones: for a bus without a brake on a busy "
        "computer")

    p.add_argument("--write-bench", type=Path, metavar="FILE",
        help="write the shipped bench file, and its JSON schema for editors beside it, and exit")
    p.add_argument("--write-schemas", type=Path, metavar="DIR",
        help="write the JSON schemas of bench, mapping, map and acceptance files into a folder, and exit")
    # fmt: on
    return p


def prepare(args: argparse.Namespace) -> Plan:
    """Check the options, and read bench and policy."""
    bench, layout = load_bench(args.bench), load_layout()
    stage, limit = _stage(args, bench)
    duration = _duration(args, bench)
    if stage is not Stage.READ_ONLY and not args.long_timeouts:
        bench.refuse_long_timeouts()
    _refuse_contradictions(args, stage)
    period = layout.command.cycle_time
    if abs(bench.timing.sample_time - period) > 1e-9:
        raise BenchFileError(
            f"timing.sample_time: the DBC's command comes every {period:g} s, got {bench.timing.sample_time:g} s"
        )
    experiment = _experiment(args, bench, duration)
    return Plan(
        iface=args.iface,
        bench=bench,
        layout=layout,
        drive=_drive(args.iface, args.drive, bench),
        stage=stage,
        limit=limit,
        duration=duration,
        experiment=experiment,
        strict=args.strict,
        precautions=Precautions(args.real_time, args.watchdog, args.confirm),
        output=Output(args.log, args.json, args.verbose, args.quiet, args.live, args.open, args.report),
        label=Label(args.typed, one_line(args.operator, LONGEST_LABEL), one_line(args.serial, LONGEST_LABEL)),
    )


def _refuse_contradictions(args: argparse.Namespace, stage: Stage) -> None:
    """Refuse options that have nothing to do beside others, and a port that is none."""
    if args.live is not None and not 0 <= args.live <= 65535:
        raise UsageError(f"--live: expected a port, 0 to 65535, got {args.live}")
    if args.open and args.live is None:
        raise UsageError("--open: expected it with --live, whose page it opens")
    for option in ("home", "quick", "stop_when", "report"):
        if stage is Stage.READ_ONLY and getattr(args, option):
            raise UsageError(f"--read-only: sends nothing, so --{option.replace('_', '-')} has nothing to do")
    if stage is Stage.ZERO and args.home:
        raise UsageError("--zero: no brake comes home with 0 A; turn it by hand, or use --limit")
    if args.confirm and not is_interactive():
        raise UsageError("--confirm: expected a terminal on standard input; --yes runs without asking")


def _experiment(args: argparse.Namespace, bench: Bench, duration: float) -> Experiment | None:
    """The experiment; None where nothing is sent: then a policy that was named is checked all the same."""
    law = make_law(bench)  # before the policy: where no shield can be made, no policy helps
    if args.stage is Stage.READ_ONLY:
        if args.policy is not None:
            _policy(args, bench)
        return None
    law = law._replace(steps=round(duration / bench.timing.sample_time))
    return Experiment(_policy(args, bench), law, _stop_condition(args, bench), args.home)


def _drive(iface: str, given: str | None, bench: Bench) -> MappedDrive | None:
    scheme, _, mapped = iface.partition(":")
    if given is None and scheme != "map":
        return None
    # Only here: most runs have no mapped drive, and each waits for the imports.
    from emb_runtime.drives.mapping import require_fit
    from emb_runtime.drives.mapping_file import load_mapping

    if scheme == "map" and not all(mapped.rpartition("@")):
        raise UsageError(f"--iface {iface}: expected map:FILE@BUS with a simulated drive on the bus")
    file, bus = Path(mapped.rpartition("@")[0]) if scheme == "map" else None, ""
    if given is not None:
        name, at, bus = given.rpartition("@")
        if not (name and at and bus) or file is not None:
            raise UsageError(f"--drive '{given}': expected FILE@BUS (drive.toml@can0), and a bus in --iface")
        if iface == bus:
            raise UsageError(
                f"--drive '{given}': expected another bus than --iface, whose identifiers differ in meaning"
            )
        file = Path(name)
    assert file is not None
    mapping = load_mapping(file)
    require_fit(mapping, bench)
    return MappedDrive(mapping, bus)


def names_a_file(path: Path) -> bool:
    """Returns True for a file to write, False for a folder of files: anything without a suffix is a folder."""
    try:
        return bool(path.suffix) and not path.is_dir()
    except OSError as err:
        raise UsageError(f"--log {path}: {err.strerror}") from err


@contextmanager
def log_folder(log: Path) -> Iterator[None]:
    """The folder for the logs that the user wants; where it was made for nothing, it is removed again."""
    folder = log.parent if names_a_file(log) else log
    try:
        made = [path for path in (folder, *folder.parents) if not path.exists()]
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as err:
        raise UsageError(
            f"--log {log}: {folder} is no folder; expected one for the logs, or a new file with a suffix: .mcap"
        ) from err
    except OSError as err:
        raise UsageError(f"--log {log}: {err.strerror}") from err
    try:
        yield
    finally:
        with suppress(OSError):  # it holds something
            for path in made:
                path.rmdir()


def log_path(log: Path, ending: str = "") -> Path:
    """Path of the next log, which must not exist; the time names it, with this ending, where the user did not."""
    path = log
    if not names_a_file(log):
        name = time.strftime("%Y%m%d-%H%M%S") + f"-{time.time_ns() // 1_000_000 % 1000:03d}"
        path = log / f"run-{name}{ending}.mcap"
    if os.path.lexists(path):  # also a link that leads nowhere
        raise UsageError(f"--log: {path}: the file exists; logs are never overwritten, choose another name")
    return path


def _stop_condition(args: argparse.Namespace, bench: Bench) -> StopCondition | None:
    estimates, goal = estimated(bench), args.stop_when
    if goal is None and args.quick:
        goal = ",".join(f"{name}={QUICK_GOAL}" for name in estimates)
    return None if goal is None else parse_stop_condition(goal, estimates)


def _policy(args: argparse.Namespace, bench: Bench) -> Policy:
    if args.policy is None:
        return load_policy(shipped_actor_path(args.quick), bench)
    try:
        return admit_policy(args.policy, bench)
    except PolicyRefusedError as err:
        raise PolicyRefusedError(f"--policy {args.policy}: {err}") from err


def _stage(args: argparse.Namespace, bench: Bench) -> tuple[Stage, float]:
    """The stage, and the largest current that it lets out [A]."""
    most = min(bench.limits.current, CEILING_CURRENT)
    if args.stage is not None:
        return args.stage, 0.0
    if args.limit is None:
        return Stage.FULL, most
    if not 0.0 < args.limit <= most:
        raise UsageError(f"--limit: expected a current in (0, {most:g}] A, the bench's limit, got {args.limit:g}")
    return Stage.LIMITED, args.limit


def _duration(args: argparse.Namespace, bench: Bench) -> float:
    """Duration of the experiment, or how long to listen [s]."""
    shortest, horizon = bench.timing.sample_time, bench.timing.horizon * bench.timing.sample_time
    longest, what = horizon, "the horizon of the bench"
    if args.stage is Stage.READ_ONLY:
        longest, what = LONGEST_READING, "a day"
    duration: float = horizon if args.duration is None else args.duration
    if not shortest <= duration <= longest:
        raise UsageError(f"--duration: expected {shortest:g} to {longest:g} s, {what}, got {duration:g}")
    return duration
