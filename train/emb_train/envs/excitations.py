"""Excitations of N experiments side by side: one interface for all that is played, searched or learned.

The requested current is not the one that acts: the shield has the last word over every excitation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from emb_bench.excitation import reference

ANGLE, VELOCITY, STEP, APPLIED = range(4)
"""Columns of the observation: angle [rad], velocity [rad/s], step, current that acted in the period before [A]."""

Seen = NDArray[np.float32]
Currents = NDArray[np.float64]


class Excitation(Protocol):
    """Source of current requests, for N experiments side by side."""

    def begin(self, count: int) -> None:
        """Begins N experiments anew."""
        ...

    def __call__(self, seen: Seen) -> Currents:
        """Requested currents [A], shape [N], for observations of shape [N, 4].

        Where a sample was lost, all but the step is NaN. Then the state does not change, and the answer does not
        count.
        """
        ...


class Stateless:
    """An excitation that remembers nothing, so that nothing is to be done at the start."""

    def begin(self, count: int) -> None:
        """Nothing is kept from one experiment to the next."""


class Played(Stateless):
    """Currents that are known beforehand, whatever is measured."""

    def __init__(self, currents: Sequence[float] | Currents) -> None:
        """Play these currents [A], one for each step, shape [T]; of each experiment its own, shape [N, T]."""
        self._currents = np.array(currents, np.float64)

    def __call__(self, seen: Seen) -> Currents:
        """See :class:`Excitation`."""
        step = seen[:, STEP].astype(np.int64)
        wanted: Currents = self._currents[(np.arange(len(step)), step) if self._currents.ndim > 1 else step]
        return wanted


class Law(Stateless):
    """A reference excitation that answers one measurement at a time, such as constant-speed."""

    def __init__(self, law: reference.Law) -> None:
        """Use this law."""
        self._law = law

    def __call__(self, seen: Seen) -> Currents:
        """See :class:`Excitation`."""
        return np.array([self._law(angle, velocity, int(step)) for angle, velocity, step, _ in seen.tolist()])


def reference_excitation(excited: reference.Excitation) -> Excitation:
    """One of :mod:`emb_bench.excitation.reference`, for many experiments."""
    return Law(excited.law) if excited.currents is None else Played(excited.currents)
