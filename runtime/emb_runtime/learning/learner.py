"""Learning in a run: fed with every sample, asked for the law of the brakes that are still possible.

Where nothing is to be learnt, and wherever anything is in doubt, the law is the one for the whole set: any sequence of
sets that hold the brake is safe, see ``docs/explanation/learning-shield.md``.
"""

from __future__ import annotations

from typing import Final

from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.learning import bounded
from emb_runtime.learning.assumptions import Assumptions, make_assumptions
from emb_runtime.learning.known import Known, State, known
from emb_runtime.learning.law import fits, law_for, middle, with_room
from emb_runtime.records import SensorSample
from emb_runtime.safety.shield_design import ShieldLaw, design_inputs

LONGEST_GAP: Final = 50
"""Periods between two samples beyond which nothing more is learnt: a node's clock may say that millions have passed."""
LONGEST_KEPT: Final = 10
"""Periods for which a law is kept, at most: it costs ten times what learning costs, and the set shrinks slowly."""


class Learner:
    """Learns while a run lasts, from its first sample on; not ``active``, it learns nothing.

    The law ``whole`` is that of the whole set. BenchFileError names an assumption that does not hold.
    """

    _heard: tuple[Assumptions, State]  # Prior knowledge and what was heard, from :meth:`begin` on
    _law: ShieldLaw | None  # The newest, the same

    def __init__(self, bench: Bench, whole: ShieldLaw, active: bool = True) -> None:
        self.whole = whole
        self.known: Known | None = None
        """Possible brakes and states at the newest sample heard; None where nothing is being learnt."""
        self.contradicted = False
        """The samples contradict the assumptions; :attr:`known` is then what was known just before."""
        self._nominal, self._inputs = bench.brake, design_inputs(bench)._replace(steps=whole.steps)
        self._prior = make_assumptions(bench) if active and bench.shield.learn else None
        self.age = 0  # Periods since the law was made

    def begin(self, sample: SensorSample) -> None:
        """Forget everything, and hear the first sample."""
        self.known, self.contradicted, self._law, self.age = None, False, None, 0
        if self._prior is not None:
            self._heard = self._prior, bounded.start(self._prior)
            self._hear(sample)

    def hear(self, sample: SensorSample, periods: int) -> None:
        """Hear a sample, so many periods after the one before; those between were lost, and their currents with them.

        A sample that does not lie on the grid of periods, or comes after a long gap, ends the learning.
        """
        if self.known is None:
            return
        if not 1 <= periods <= LONGEST_GAP:
            self.known = None
            return
        self.age += periods
        assumptions, state = self._heard
        for _ in range(periods - 1):
            bounded.lose(assumptions, state)
        self._hear(sample)

    def _hear(self, sample: SensorSample) -> None:
        assumptions, state = self._heard
        bounded.hear(assumptions, state, sample.angle, sample.velocity, sample.applied_current)
        now = known(state)
        if now.falsified:
            self.contradicted = True
        else:
            self.known = now

    def question(self, sample: SensorSample) -> tuple[ShieldLaw, float, float]:
        """Law of the shield for the newest sample, and its state: the middle of the known box [rad, rad/s]."""
        if self.known is None or self.contradicted:
            return self.whole, sample.angle, sample.velocity
        if self._law is None or self.age >= LONGEST_KEPT or not fits(self._law, self.known):
            self._law, self.age = law_for(self._inputs, self._nominal, with_room(self._inputs, self.known)), 0
        angle, velocity = middle(self.known)
        return self._law, angle, velocity


def ranges_of(known: Known) -> dict[str, tuple[float, float]]:
    """Least and greatest relative value of each parameter, by its name."""
    return {name: (known[2 * i], known[2 * i + 1]) for i, name in enumerate(PARAMETER_NAMES)}


def words(known: Known) -> str:
    """The ranges for a person, relative to the nominal brake."""
    return ", ".join(f"{name} {low:.3f} to {high:.3f}" for name, (low, high) in ranges_of(known).items())
