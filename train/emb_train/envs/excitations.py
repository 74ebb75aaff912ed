"""Excitations of N experiments side by side: one interface for all that is played, searched or learned.

The requested current is not the one that acts: the shield has the last word over every excitation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from emb_bench.excitation import reference
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.inference import INPUT_NAME, NEXT_STATE_NAME, OUTPUT_NAME, STATE_NAME, open_session

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


class OnnxFile:
    """An exported actor in ONNX Runtime, one experiment after the other, as the runtime calls it."""

    def __init__(self, data: bytes, initial_state: Sequence[float] = ()) -> None:
        """Open a file, whose contract :func:`emb_runtime.policy.policy.load_policy` has checked.

        Args:
            data: its bytes.
            initial_state: of its contract, S numbers; none for an actor without state.

        Raises:
            PolicyRefusedError: ONNX Runtime refuses it, or its state is not the one of the contract.
        """
        self._session = open_session(data)
        shapes = {port.name: port.shape for port in self._session.get_inputs()}
        size = shapes[STATE_NAME][1] if STATE_NAME in shapes else 0
        if INPUT_NAME not in shapes or size != len(initial_state):
            raise PolicyRefusedError(
                f"expected the inputs '{INPUT_NAME}' and, of {len(initial_state)} numbers, '{STATE_NAME}', got {shapes}"
            )
        self._width = int(shapes[INPUT_NAME][1])
        self._outputs = [OUTPUT_NAME, NEXT_STATE_NAME] if size else [OUTPUT_NAME]
        self._initial = np.array(initial_state, np.float64)
        self._state = np.zeros((0, size))

    def begin(self, count: int) -> None:
        """Every experiment begins with the initial state."""
        self._state = np.tile(self._initial, (count, 1))

    def __call__(self, seen: Seen) -> Currents:
        """See :class:`Excitation`."""
        observed = np.ascontiguousarray(seen[:, : self._width])
        wanted = np.zeros(len(seen))
        for i in np.flatnonzero(~np.isnan(seen[:, ANGLE])):
            feed = {INPUT_NAME: observed[i : i + 1]}
            if self._initial.size:
                feed[STATE_NAME] = self._state[i : i + 1]
            current, *following = self._session.run(self._outputs, feed)
            wanted[i] = current.item()
            if following:
                self._state[i] = following[0][0]
        return wanted
