"""Under what an experiment runs in training: shield or none, how long, what is seen, which information counts.

The defaults are those of a bench that runs a deployed actor. The thesis trains under others (sections 4.6, 5.2, 6.2):
no shield, an action is clipped to ±6 A, and leaving the limits ends the experiment.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import get_args

from emb_bench.information import Kind
from emb_bench.packed import packed_size
from emb_runtime.bench import Bench
from emb_runtime.errors import UsageError

MEASURED, EVERYTHING = "measured", "everything"


@dataclass(frozen=True)
class Conditions:
    """How an experiment of the training differs from one on the bench."""

    shielded: bool = True
    """Whether the shield is between actor and brake; without it an action is clipped and nothing else."""
    shield_ranges: str = ""
    """The set of the bench that the shield holds the limits for; empty for the one that the bench names."""
    horizon: int = 0
    """Steps in one experiment; 0 for the bench's."""
    observes: str = MEASURED
    """What the actor sees: ``measured`` angle, velocity and the step, or ``everything`` (x₁, x₂, k, θ and the FIM)."""
    information: str = "weighted"
    """Which Fisher information is collected: the thesis's ``weighted`` one, or the ``physical`` one."""

    def __post_init__(self) -> None:
        """Refuse what does not exist.

        Raises:
            UsageError: a name or the horizon is out of its range.
        """
        if self.horizon < 0:
            raise UsageError(f"horizon: expected steps, or 0 for the bench's, got {self.horizon}")
        if self.horizon and self.shielded:
            raise UsageError("horizon: the shield plans for the bench's; only an experiment without it has another")
        for name, known in (("observes", (MEASURED, EVERYTHING)), ("information", get_args(Kind))):
            if getattr(self, name) not in known:
                raise UsageError(f"{name}: expected one of {', '.join(known)}, got {getattr(self, name)!r}")

    @property
    def kind(self) -> Kind:
        """The information, as :mod:`emb_bench.information` calls it."""
        return "physical" if self.information == "physical" else "weighted"

    def observation_size(self, count: int) -> int:
        """Length of the actor's observation if the information of this many parameters is collected."""
        return 3 if self.observes == MEASURED else 3 + count + packed_size(count)

    def applied(self, bench: Bench) -> Bench:
        """The bench with this horizon and this set of brakes for the shield."""
        timing = replace(bench.timing, horizon=self.horizon or bench.timing.horizon)
        shield = replace(bench.shield, ranges=self.shield_ranges or bench.shield.ranges)
        return replace(bench, timing=timing, shield=shield)


BENCH_CONDITIONS = Conditions()
