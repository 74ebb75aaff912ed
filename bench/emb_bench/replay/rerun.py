"""``emb-replay rerun``: runs the loop again from a log and compares its decisions with the recorded ones."""

from __future__ import annotations

import argparse
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import msgspec

from emb_bench.logs.log import RunLog, read_log, require_driven
from emb_bench.replay.playback import Difference, Playback
from emb_runtime.config.bench import CEILING_CURRENT
from emb_runtime.control.core import Core
from emb_runtime.control.homing import Still, homing_steps
from emb_runtime.control.interfaces import Actor
from emb_runtime.control.result import Outcome
from emb_runtime.control.stop_condition import StopCondition, parse_stop_condition
from emb_runtime.drives.mapping import mapping_hash
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, LogError, UsageError
from emb_runtime.estimator.estimator import estimated
from emb_runtime.log.recorder_process import DIED
from emb_runtime.records import RunState
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.shield_design import make_law
from emb_runtime.system.terminal import as_json, show

if TYPE_CHECKING:
    from emb_runtime.policy.policy import Policy

SHOWN = 10  # Most differences that are printed; JSON has all

HELP = "run the loop again from the log: does it decide the same?"
DESCRIPTION = """\
Run the loop of emb-run once more, with the policy, the bench and the DBC that the log carries, on a bus and a clock
that play what the log recorded. Each decision (policy, clip, shield, what was sent and why), each frame that was sent,
each safety event and the outcome must come out again, numbers to the last bit. A log that ends before its run does is
followed as far as it goes.

Rounding may differ with another ONNX Runtime, numpy, Python or processor; with differences, what is another one is
named.
"""


class Recorded(msgspec.Struct, frozen=True):
    """Part of a log's identity that the loop depends on."""

    purpose: Literal["experiment", "homing"]
    steps: Annotated[int, msgspec.Meta(ge=1)]  # Samples that the run was to answer
    limit: Annotated[float, msgspec.Meta(ge=0.0, le=CEILING_CURRENT)]  # Largest current that might be sent [A]


class Version(NamedTuple):
    """Version that a run was made with, and the version here."""

    name: str
    recorded: str
    here: str


@dataclass(frozen=True)
class Rerun:
    """Result of running a log's loop again."""

    decisions: int  # Cycle records compared
    frames: int  # Sent frames compared
    events: int  # Safety events compared
    differences: tuple[Difference, ...]  # Differences in the order in which they occurred
    followed: bool
    """True if the whole log was played; if not, the loop diverged from it, and the last difference shows where."""
    outcome: Outcome | None
    """Outcome of the rerun; None if it diverged from the log, or the log ended, before the rerun did."""

    @property
    def reproduced(self) -> bool:
        """Returns True if everything came out as recorded."""
        return not self.differences


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument("log", type=Path, metavar="LOG", help="MCAP file of emb-run")
    p.add_argument("--json", action="store_true", help="print JSON, with every difference")


def run(args: argparse.Namespace) -> int:
    """Runs a log's loop again; returns the exit code.

    Raises:
        UsageError: the file cannot be read, or is a recording of others.
        LogError: it is no log, or lacks what a rerun needs.
        PolicyRefusedError: the policy in the log is refused.
    """
    log = read_log(args.log)
    if log.imported:
        raise UsageError(f"{args.log}: a recording of others has no loop to run again")
    if recorded_run(log).purpose == "homing":
        again = rerun(log, Still(), log.bench.limits.current)
        carried: dict[str, str] = {}
    else:
        policy = carried_policy(log)
        again = rerun(log, policy, policy.contract.limits.current, _stop_condition(log))
        carried = {"policy_sha256": policy.sha256}
    again = replace(again, differences=(*_identity(log, carried), *again.differences))
    show(as_json(document(log, again)) if args.json else text(log, again))
    return EXIT_DONE if again.reproduced else EXIT_CHECK_FAILED


def carried_policy(log: RunLog) -> Policy:
    """The policy that a log carries, with every check that ``emb-run`` makes.

    Raises:
        LogError: the log carries none.
        PolicyRefusedError: it is refused.
    """
    if "policy.onnx" not in log.attachments:
        raise LogError(f"{log.path}: the log carries no policy.onnx, so its decisions cannot be made again")
    from emb_runtime.policy.trial import admit_policy  # takes its time, and no other command needs it

    return admit_policy(log.attachments["policy.onnx"], log.bench)


def rerun(log: RunLog, actor: Actor, current_limit: float, stop_condition: StopCondition | None = None) -> Rerun:
    """Run the loop of a log again.

    Args:
        log: what was recorded.
        actor: what decided.
        current_limit: largest current that its contract allows [A].
        stop_condition: of the run, if it had one.

    Raises:
        LogError: the log lacks what a rerun needs.
    """
    bench, layout, run = log.bench, log.layout, recorded_run(log)
    playback = Playback(log)
    core = Core(
        bench=bench,
        layout=layout,
        law=make_law(bench)._replace(steps=run.steps),
        actor=actor,
        current_limit=current_limit,
        steps=run.steps,
        guard=Guard(layout, bench, playback.send, limit=run.limit),
        limit=run.limit,
        homing=run.purpose == "homing",
        stop_condition=stop_condition,
    )
    playback.play(core)
    outcome = core.outcome() if core.state is RunState.OVER and playback.at_end else None
    return Rerun(
        decisions=playback.decisions,
        frames=playback.frames,
        events=playback.events,
        differences=(*playback.differences, *(() if outcome is None else _end(log.end, outcome))),
        followed=playback.at_end,
        outcome=outcome,
    )


def recorded_run(log: RunLog) -> Recorded:
    """Identity of a log's run, as far as the loop depends on it.

    Raises:
        UsageError: nothing was driven.
        LogError: it is not that of a run.
    """
    require_driven(log)
    try:
        run = msgspec.convert(dict(log.run), Recorded, strict=False)
    except msgspec.ValidationError as err:
        raise LogError(f"{log.path}: emb.run: {err}") from err
    most = homing_steps(log.bench) if run.purpose == "homing" else log.bench.timing.horizon
    if run.steps > most:
        raise LogError(f"{log.path}: emb.run: steps: expected at most {most}, got {run.steps}")
    return run


def _stop_condition(log: RunLog) -> StopCondition | None:
    """Stop condition of the run, if it had one."""
    stop_when = log.run.get("stop_when")
    try:
        return None if stop_when is None else parse_stop_condition(stop_when, estimated(log.bench))
    except UsageError as err:
        raise LogError(f"{log.path}: emb.run: stop_when: {err}") from err


def _end(recorded: Mapping[str, str], outcome: Outcome) -> list[Difference]:
    """Differences between the outcome in the log's trailer and that of the rerun; a run whose process died has none."""
    if recorded.get("exit_reason", DIED) == DIED:
        return []
    came = {"exit_reason": outcome.fault.name if outcome.fault else "DONE"}
    came |= {name: str(value) for name, value in asdict(outcome.counters).items()}
    return [
        Difference(None, name, recorded[name], value)
        for name, value in came.items()
        if name in recorded and recorded[name] != value
    ]


def _identity(log: RunLog, carried: Mapping[str, str]) -> list[Difference]:
    """Differences between the hashes of what the log carries and those that it records."""
    recorded = dict(log.run)
    if log.drive_files is not None:
        carried = {**carried, "mapping_sha256": mapping_hash(*log.drive_files)}
        recorded["mapping_sha256"] = log.metadata["emb.drive"]["sha256"]
    return [
        Difference(None, name, recorded[name], value)
        for name, value in {**carried, "bench_hash": log.bench.identity_hash}.items()
        if recorded.get(name, value) != value
    ]


def versions(log: RunLog) -> tuple[Version, ...]:
    """Versions in the log that differ from those here."""
    here = {
        "tool": f"emb-excite {metadata.version('emb-excite')}",
        "onnxruntime": metadata.version("onnxruntime"),
        "numpy": metadata.version("numpy"),
        "python": platform.python_version(),
    }
    pairs = (Version(name, log.run.get(name, ""), value) for name, value in here.items())
    return tuple(pair for pair in pairs if pair.recorded and pair.recorded != pair.here)


def document(log: RunLog, again: Rerun) -> dict[str, Any]:
    """The result as plain data."""
    return {
        "log": str(log.path),
        "complete": log.complete,
        "missing": log.missing,
        "reproduced": again.reproduced,
        "decisions": again.decisions,
        "frames": again.frames,
        "events": again.events,
        "ended": again.outcome is not None,
        "home": None if again.outcome is None else again.outcome.home,
        "followed": again.followed,
        "other_versions": [version._asdict() for version in versions(log)],
        "differences": [difference._asdict() for difference in again.differences],
    }


def text(log: RunLog, again: Rerun) -> str:
    """Result as text."""
    others = versions(log)
    lines = [f"made with {v.recorded}, run again with {v.here}" for v in others if v.name == "tool"]
    if log.missing:
        lines.append(f"WARNING: {log.missing}")
    counts = f"{again.decisions} decisions, {again.frames} sent frames, {again.events} events"
    if again.reproduced:
        lines.append(f"reproduced   each of {counts}")
    else:
        found = len(again.differences)
        lines.append(f"NOT reproduced: {found} difference{'s' * (found != 1)} in {counts}")
    if again.outcome is not None:
        home = "home" if again.outcome.home else "not home"
        lines.append(f"outcome      {again.outcome.fault.name if again.outcome.fault else 'DONE'}, {home}")
    elif again.followed:
        lines.append("outcome      none: the log ends before the run does, and was followed up to there")
    else:
        lines.append("outcome      none: the loop went another way than the log, the last difference says where")
    for difference in again.differences[:SHOWN]:
        where = "" if difference.step is None else f"step {difference.step}, "
        lines.append(f"  {where}{difference.what}: recorded {difference.recorded}, came {difference.came}")
    if len(again.differences) > SHOWN:
        lines.append(f"  and {len(again.differences) - SHOWN} more (--json has all)")
    if not again.reproduced:
        lines += [
            f"  {v.name} was {v.recorded}, here {v.here}: rounding may differ" for v in others if v.name != "tool"
        ]
    return "\n".join(lines)
