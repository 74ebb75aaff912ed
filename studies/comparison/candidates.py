"""Candidates of a comparison: reference excitations, actors and designs, in a form that travels to another process."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from emb_bench.brake.motion import Floats
from emb_bench.design.report import read_design
from emb_bench.excitation.reference import ACTOR, COMPARED, EXCITATIONS, Excitation, parse_excitation
from emb_bench.parallel.processes import Lost, shared_out
from emb_runtime.config.bench import Bench, parse_bench
from emb_runtime.control.interfaces import Actor
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_runtime.policy.trial import admit_policy

OPTIMAL = "optimal"  # The D-optimal design for the nominal brake, searched for at the start
DESIGN_STARTS = 6  # Coarse searches for it: three find the same to 1e-4 in log det
DESIGN_SEED = 0


@dataclass(frozen=True, eq=False)
class Candidate:
    """An excitation before it is built: an actor's file, a sequence, or a text."""

    name: str  # Name in the tables
    origin: str  # Description, with a hash of what was read from a file
    learned: bool = False
    trained: tuple[str, ...] = ()  # Parameters in which the brakes differed that it learned on
    text: str = ""  # Text for :func:`emb_bench.excitation.reference.parse_excitation`; empty for an actor or a sequence
    onnx: bytes = b""
    currents: Floats | None = None  # [A], shape (horizon,)

    def built(self, bench: Bench) -> Actor:
        """Returns the excitation as an actor, ready to be played.

        Raises:
            UsageError: the text names none.
            PolicyRefusedError: the actor does not fit the bench, or later requests a current that is not finite.
        """
        if self.text:
            return parse_excitation(self.text, bench)
        if self.currents is not None:
            sequence = self.currents.tolist()
            return Excitation(self.name, MappingProxyType({}), lambda _angle, _velocity, k: sequence[k], self.currents)
        return _Played(self.name, load_policy(self.onnx, bench))


class _Played:
    """Actor whose currents are checked."""

    def __init__(self, name: str, actor: Actor) -> None:
        self._name, self._actor = name, actor

    @property
    def estimate(self) -> tuple[float, ...]:
        """Estimate of the actor."""
        return self._actor.estimate

    def begin(self) -> None:
        """A run begins."""
        self._actor.begin()

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        """Current that the actor requests [A]; raises PolicyRefusedError where the runtime stops."""
        wanted = self._actor.act(angle, velocity, step, applied_current)
        if not math.isfinite(wanted):
            raise PolicyRefusedError(f"{self._name}: expected a finite current at sample {step:g}, got {wanted}")
        return wanted


DEFAULT = (ACTOR, OPTIMAL, *COMPARED)  # Default candidates


def read_candidates(names: Sequence[str], bench: Bench, params: Sequence[str]) -> tuple[Candidate, ...]:
    """Read all that are named; the design that has to be searched for comes last, for it takes its time.

    Args:
        names: texts of excitations, ``actor``, ``optimal``, or paths that end in .onnx or .npz.
        bench: the bench that they drive.
        params: parameters that ``optimal`` is optimal for.

    Raises:
        UsageError: a name is unknown or comes twice, or a file cannot be read or is for another bench.
        PolicyRefusedError: an actor is damaged or does not fit the bench.
    """
    found = {}
    for name in names:
        if name in found:
            raise UsageError(f"'{name}' is named twice: expected each excitation once")
        found[name] = None if name == OPTIMAL else _read(name, bench)
    if len({c.name for c in found.values() if c}) < len([c for c in found.values() if c]):
        raise UsageError("two files have the same name: expected names that can be told apart in a table")
    return tuple(_searched(bench, params) if made is None else made for made in found.values())


def _read(name: str, bench: Bench) -> Candidate:
    path = Path(name)
    if name == ACTOR:
        return _actor(name, shipped_actor_path(), bench)
    if path.suffix == ".onnx":
        return _actor(path.name, path, bench)
    if path.suffix == ".npz":
        return _design(path, bench)
    if name.partition(":")[0].strip() not in EXCITATIONS:
        kinds = ", ".join((ACTOR, OPTIMAL, *EXCITATIONS))
        raise UsageError(f"'{name}' is no excitation: expected {kinds}, POLICY.onnx or DESIGN.npz")
    return Candidate(name, parse_excitation(name, bench).text, text=name)


def _actor(name: str, path: Path, bench: Bench) -> Candidate:
    try:
        policy = load_policy(path, bench) if name == ACTOR else admit_policy(path, bench)
    except PolicyRefusedError as err:
        raise PolicyRefusedError(f"{path}: {err}") from err
    ranges = {key: pair for key, pair in policy.contract.ranges.items() if pair[0] < pair[1]}
    said = ", ".join(f"{key} {low:g}..{high:g}" for key, (low, high) in ranges.items()) or "one brake"
    origin = f"actor trained on {said}, sha256 {policy.sha256[:12]}"
    return Candidate(name, origin, learned=True, trained=tuple(ranges), onnx=policy.data)


def _design(path: Path, bench: Bench) -> Candidate:
    currents, origin = read_design(path, bench)
    return Candidate(path.name, origin, currents=currents)


def _searched(bench: Bench, params: Sequence[str]) -> Candidate:
    """The optimum, from a process of its own: a Ctrl-C ends that at once, and the threads of a search only in time."""
    with closing(shared_out(_search, [(bench.text, tuple(params))], 1)) as results:
        (_, found), *_ = results
    if isinstance(found, Lost):
        raise UsageError(f"the process that searched the optimum {found.how}, out of memory perhaps")
    return found


def _search(job: tuple[str, tuple[str, ...]]) -> Candidate:
    text, params = job
    return optimal(parse_bench(text, "the bench"), params)


def optimal(bench: Bench, params: Sequence[str]) -> Candidate:
    """The D-optimal sequence for the nominal brake, solved exactly; it comes home.

    Raises:
        UsageError: none was found that keeps the limits.
    """
    from emb_bench.design.problem import make_problem
    from emb_bench.design.search import search
    from emb_bench.information.criteria import criterion

    problem = make_problem(bench, criterion("D", params), tuple(params))
    best = search(problem, starts=DESIGN_STARTS, seed=DESIGN_SEED).best
    searched = f"{DESIGN_STARTS} starts, seed {DESIGN_SEED}"
    origin = f"D-optimal for the nominal brake if it is known, log det {best.phi:.2f} there ({searched})"
    return Candidate(OPTIMAL, origin, currents=best.currents)
