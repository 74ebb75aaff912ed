"""Conditions of an experiment in training: shield, horizon, observation, kind of information, late and lost frames.

The defaults are those of a bench that runs a deployed actor. The thesis trains under others (sections 4.6, 5.2, 6.2):
no shield, an action is clipped to ±6 A, and leaving the limits ends the experiment.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from emb_bench.config.bench import Bench
from emb_bench.information.fisher import Kind
from emb_bench.information.symmetric import packed_size
from emb_runtime.config.bench import OLDEST_FRAME
from emb_runtime.errors import UsageError

MEASURED: Literal["measured"] = "measured"
EVERYTHING: Literal["everything"] = "everything"
MOST_LOST = 0.5  # Largest probability that a sample is lost

Bools = NDArray[np.bool_]


class Conditions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Conditions in which an experiment of the training may differ from one on the bench."""

    shielded: bool = True  # True if the shield is between actor and brake; without it an action is clipped, no more
    shield_ranges: str | None = None  # Set of the bench that the shield covers; None for the one that the bench names
    horizon: int = 0  # Steps in one experiment; 0 for the bench's
    observes: Literal["measured", "everything"] = MEASURED
    """Observation of the actor: ``measured`` angle, velocity and step, or ``everything`` (x₁, x₂, k, θ, the FIM)."""
    information: Kind = "weighted"  # Fisher information that is collected: the thesis's, or the physical one
    command_delay: tuple[int, int] = (0, 0)
    """Least and most samples that a command waits beside the plant's own delay, drawn for each experiment."""
    frame_loss: tuple[float, float] = (0.0, 0.0)
    """Least and greatest probability with which a sample does not arrive, drawn for each experiment: then nothing is
    sent, and the node brakes. The first sample always arrives, and never as many in a row are lost as end a run."""

    def __post_init__(self) -> None:
        """Refuse what does not exist.

        Raises:
            UsageError: a range or the horizon is out of its bounds.
        """
        for name, most in (("command_delay", OLDEST_FRAME), ("frame_loss", MOST_LOST)):
            low, high = getattr(self, name)
            if not 0 <= low <= high <= most:  # written so that NaN fails
                raise UsageError(f"{name}: expected least and most, from 0 to {most:g}, got {low:g}, {high:g}")
        if self.horizon < 0:
            raise UsageError(f"horizon: expected steps, or 0 for the bench's, got {self.horizon}")
        if self.horizon and self.shielded:
            raise UsageError("horizon: the shield plans for the bench's; only an experiment without it has another")

    @property
    def varies(self) -> bool:
        """True if experiments have a delay or losses of their own."""
        return self.command_delay[1] > 0 or self.frame_loss[1] > 0.0

    def observation_size(self, count: int) -> int:
        """Length of the actor's observation if the information of this many parameters is collected."""
        return 3 if self.observes == MEASURED else 3 + count + packed_size(count)

    def applied(self, bench: Bench) -> Bench:
        """The bench with this horizon, and a shield for this set of brakes that covers the drawn delays as well.

        It covers what the bench's shield covers or what is drawn, not the sum of both: right for a plant without a
        delay of its own. It plans for lost frames anyway.
        """
        timing = replace(bench.timing, horizon=self.horizon or bench.timing.horizon)
        shield = bench.shield._replace(ranges=self.shield_ranges or bench.shield.ranges)
        if self.shielded and self.varies:
            (least, most), (low, high) = shield.frame_age, self.command_delay
            shield = shield._replace(frame_age=(min(least, low), max(most, high)))
        return replace(bench, timing=timing, shield=shield)

    def drawn(self, rng: np.random.Generator, samples: int, longest: int) -> tuple[int, Bools]:
        """Draws what one experiment has of its own.

        Args:
            rng: draws the same number of times, whatever varies.
            samples: of the experiment, the first and the last included.
            longest: as many samples in a row may be lost, see :func:`longest_loss`.

        Returns:
            Samples that its commands wait, and which samples do not arrive, shape [samples].
        """
        delay = int(rng.integers(self.command_delay[0], self.command_delay[1] + 1))
        lost = rng.random(samples) < rng.uniform(*self.frame_loss)
        lost[[0, -1]] = False  # the first begins the experiment, the last only ends it
        sample = np.arange(samples)
        in_a_row = sample - np.maximum.accumulate(np.where(lost, 0, sample))
        return delay, lost & (in_a_row % (longest + 1) != 0)


BENCH_CONDITIONS = Conditions()


def longest_loss(bench: Bench) -> int:
    """Samples in a row that may be lost without an end of the run: neither the node nor the loop gives up [samples]."""
    node = math.ceil(bench.node.watchdog / bench.timing.sample_time - 1e-9)
    return max(min(node, bench.watch.stop_missed) - 1, 0)
