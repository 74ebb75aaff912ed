"""Excitations of N experiments side by side: one interface for all that is played, searched or learned.

The requested current is not the one that acts: the shield has the last word over every excitation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from emb_bench.excitation import reference
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.inference import INPUT_NAME, NEXT_STATE_NAME, OUTPUT_NAME, STATE_NAME, open_session

ANGLE, VELOCITY, STEP, APPLIED = range(4)
"""Columns of the observation: angle [rad], velocity [rad/s], step, current that acted in the period before [A]."""

PLAIN = 3  # Columns of the observation of an actor that does not see the applied current

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


class Constant(Stateless):
    """A constant current."""

    def __init__(self, current: float) -> None:
        """With this current [A]."""
        self._current = current

    def __call__(self, seen: Seen) -> Currents:
        """See :class:`Excitation`."""
        return np.full(len(seen), self._current)


class Played(Stateless):
    """A sequence of currents, whatever is measured."""

    def __init__(self, currents: Sequence[float] | Currents) -> None:
        """Play these currents [A], one for each step."""
        self._currents = np.array(currents, np.float64)

    def __call__(self, seen: Seen) -> Currents:
        """See :class:`Excitation`."""
        wanted: Currents = self._currents[seen[:, STEP].astype(np.int64)]
        return wanted


def switch(current: float, step: int, horizon: int) -> Played:
    """``current`` [A] until ``step``, then its negative."""
    return Played(np.where(np.arange(horizon) < step, current, -current))


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


class Network(Stateless):
    """A network without state: raw observations [N, 3] to currents [A], [N, 1]; no exploration."""

    def __init__(self, module: nn.Module) -> None:
        """Use this module, :class:`emb_train.ppo.networks.DeployedActor` for one."""
        self._module = module

    def __call__(self, seen: Seen) -> Currents:
        """See :class:`Excitation`."""
        with torch.no_grad():
            currents = self._module(torch.from_numpy(np.ascontiguousarray(seen[:, :PLAIN])))
        return _column(currents.numpy())


class StatefulNetwork:
    """A network with state: (obs [N, 3 or 4], state [N, S]) to (currents [A] [N, 1], next state, estimate)."""

    def __init__(self, module: Any) -> None:
        """Use this module; it has the attributes ``initial_state``, shape [S], and ``observation_size``."""
        self._module = module
        self._state = torch.zeros(0, 0, dtype=torch.float64)

    def begin(self, count: int) -> None:
        """Every experiment begins with the initial state."""
        self._state = self._module.initial_state.detach().to(torch.float64).repeat(count, 1)

    def __call__(self, seen: Seen) -> Currents:
        """See :class:`Excitation`."""
        observed = torch.from_numpy(np.ascontiguousarray(seen[:, : self._module.observation_size]))
        with torch.no_grad():
            currents, state, *_ = self._module(observed, self._state)
        self._state = torch.where(observed[:, :1].isnan(), self._state, state)
        return _column(currents.numpy())


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


def _column(currents: Any) -> Currents:
    if currents.ndim != 2 or currents.shape[1] != 1:
        raise UsageError(f"expected an actor that gives one current for each experiment, got shape {currents.shape}")
    return np.array(currents[:, 0], np.float64)
