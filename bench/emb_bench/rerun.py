"""A run again from its log: the same core with the same bench, policy and settings, see :mod:`emb_bench.playback`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec

from emb_bench.logs.log import RunLog, require_driven
from emb_bench.playback import Difference, Playback
from emb_runtime.config.bench import CEILING_CURRENT
from emb_runtime.control.actor import Actor, Still, homing_steps
from emb_runtime.control.core import Core
from emb_runtime.control.result import Outcome
from emb_runtime.control.setup import Setup
from emb_runtime.control.stop_condition import StopCondition, parse_stop_condition
from emb_runtime.drives.mapping import mapping_hash
from emb_runtime.errors import LogError, UsageError
from emb_runtime.estimator.estimator import estimated
from emb_runtime.log.recorder_process import DIED
from emb_runtime.records import RunState
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.shield_design import make_law

if TYPE_CHECKING:
    from emb_runtime.policy.policy import Policy


class Recorded(msgspec.Struct, frozen=True):
    """Part of a log's identity that the loop depends on."""

    purpose: Literal["experiment", "homing"]
    steps: Annotated[int, msgspec.Meta(ge=1)]  # Samples that the run was to answer
    limit: Annotated[float, msgspec.Meta(ge=0.0, le=CEILING_CURRENT)]  # Largest current that might be sent [A]


@dataclass(frozen=True)
class Rerun:
    """Result of running a log's loop again."""

    log: RunLog
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


def rerun_as_recorded(log: RunLog) -> Rerun:
    """Run the loop of a log again with the policy that it carries, and compare what it carries with its hashes."""
    if recorded_run(log).purpose == "homing":
        again = rerun(log, Still(), log.bench.limits.current)
        carried: dict[str, str] = {}
    else:
        policy = carried_policy(log)
        again = rerun(log, policy, policy.contract.limits.current, _stop_condition(log))
        carried = {"policy_sha256": policy.sha256}
    return replace(again, differences=(*_identity(log, carried), *again.differences))


def carried_policy(log: RunLog) -> Policy:
    """The policy that a log carries, with every check that ``emb-run`` makes."""
    if "policy.onnx" not in log.attachments:
        raise LogError(f"{log.path}: the log carries no policy.onnx, so its decisions cannot be made again")
    from emb_runtime.policy.trial import admit_policy  # takes its time, and no other command needs it

    return admit_policy(log.attachments["policy.onnx"], log.bench)


def rerun(log: RunLog, actor: Actor, current_limit: float, stop_condition: StopCondition | None = None) -> Rerun:
    """Run the loop of a log again with what decided, the largest current of its contract [A] and its stop condition."""
    bench, layout, run = log.bench, log.layout, recorded_run(log)
    playback = Playback(log)
    guard = Guard(layout, bench, playback.send, limit=run.limit)
    law, homing = make_law(bench)._replace(steps=run.steps), run.purpose == "homing"
    setup = Setup(bench, layout, law, actor, current_limit, run.steps, guard, run.limit, homing, stop_condition)
    core = Core(setup)
    playback.play(core)
    outcome = core.outcome() if core.state is RunState.OVER and playback.at_end and not playback.cut else None
    return Rerun(
        log=log,
        decisions=playback.counts["decisions"],
        frames=playback.counts["frames"],
        events=playback.counts["events"],
        differences=(*playback.differences, *(() if outcome is None else _end(log.end, outcome))),
        followed=playback.at_end,
        outcome=outcome,
    )


def recorded_run(log: RunLog) -> Recorded:
    """Identity of a log's run, as far as the loop depends on it."""
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
    return _differences(recorded, came | {name: str(value) for name, value in asdict(outcome.counters).items()})


def _identity(log: RunLog, carried: Mapping[str, str]) -> list[Difference]:
    """Differences between the hashes of what the log carries and those that it records."""
    recorded, came = dict(log.run), {**carried, "bench_hash": log.bench.identity_hash}
    if log.drive_files is not None:
        came["mapping_sha256"] = mapping_hash(*log.drive_files)
        recorded["mapping_sha256"] = log.metadata["emb.drive"]["sha256"]
    return _differences(recorded, came)


def _differences(recorded: Mapping[str, str], came: Mapping[str, str]) -> list[Difference]:
    found = ((name, recorded.get(name, value), value) for name, value in came.items())
    return [Difference(None, name, said, value) for name, said, value in found if said != value]
