"""Brakes moved through currents by open-loop simulation, finite differences of their motion, and the Euler brake."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from emb_bench.brake.motion import Floats, no_sensitivity, rest
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.plants import BUILT_IN, Mechanics, Plant
from emb_bench.experiment.experiment import planned
from emb_bench.experiment.simulate import Theta, simulate
from emb_bench.information.fisher import Fisher, Kind, information_over_time, weights_along
from emb_bench.sim.open_loop import march, trajectory, zero_order_hold
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, load_bench

T_S = 1e-3
NOMINAL = load_bench().brake
EXACT = Mechanics()
RELATIVE = ("k_m", "k_1", "T_c", "f_v", "J")
ALL = (*RELATIVE, "contact", "delay", "current_offset", "x1_0", "x2_0")
STEP = 1e-6  # Of the differences, relative or in the unknown's unit


def whole(
    mechanics: Mechanics,
    p: BrakeParameters,
    currents: Floats,
    x0: tuple[float, float],
    params: tuple[str, ...] = (),
    contact: float = 0.0,
    late: float = 0.0,
    current_offset: float = 0.0,
) -> tuple[Floats, Floats]:
    """A brake whose contact begins at ``contact`` [rad] and whose commands come ``late`` samples late, compiled.

    A current of ``current_offset`` [A] acts besides, and did so before.

    All of its states, shape (n + 1, STATES), and the sensitivities of angle and velocity at the samples y_1..y_n.
    """
    (chosen, s), x = no_sensitivity(params), rest()
    x[:2], x[3] = (x0[0] - contact, x0[1]), current_offset
    acting = currents + current_offset
    states, sensitivities = trajectory(compiled(march), mechanics, p, zero_order_hold(acting, T_S, late), chosen, x, s)
    states[:, 0] += contact
    return states, sensitivities[1:, :, :2]


def moved(
    mechanics: Mechanics,
    p: BrakeParameters,
    currents: Floats,
    x0: tuple[float, float],
    contact: float = 0.0,
    late: float = 0.0,
    current_offset: float = 0.0,
) -> Floats:
    """Angle and velocity of :func:`whole`, shape (n + 1, 2)."""
    return whole(mechanics, p, currents, x0, (), contact, late, current_offset)[0][:, :2]


def changed(
    mechanics: Mechanics, p: BrakeParameters, currents: Floats, x0: tuple[float, float], name: str, by: float
) -> Floats:
    """The states if the unknown ``name`` were larger by ``by``, relative or in its unit."""
    if name in RELATIVE:
        return moved(mechanics, p._replace(**{name: getattr(p, name) * (1.0 + by)}), currents, x0)
    if name in Mechanics._fields:
        feature = {name: getattr(mechanics, name) * (1.0 + by)}
        return moved(Mechanics(**(mechanics._asdict() | feature)), p, currents, x0)
    if name == "contact":
        return moved(mechanics, p, currents, x0, contact=by)
    if name == "delay":
        return moved(mechanics, p, currents, x0, late=by)
    if name == "current_offset":
        return moved(mechanics, p, currents, x0, current_offset=by)
    start = (x0[0] + by, x0[1]) if name == "x1_0" else (x0[0], x0[1] + by)
    return moved(mechanics, p, currents, start)


def marched(
    mechanics: Mechanics, p: BrakeParameters, currents: Floats, x0: tuple[float, float], params: tuple[str, ...] = ALL
) -> tuple[Floats, Floats]:
    """States and sensitivities as :func:`emb_bench.experiment.simulate.simulate` has them, compiled."""
    states, sensitivities = whole(mechanics, p, currents, x0, params)
    return states[:, :2], sensitivities


class Events(NamedTuple):
    """How often each kind of event shows in the samples of a trajectory."""

    reversed: int
    stuck: int
    released: int
    contact_left: int
    saturated: int  # Hysteresis, or play
    contact_made: int


def events(states: Floats, m: Mechanics = EXACT) -> Events:
    """Count what happened between the samples; states of angle and velocity alone saturate nothing."""
    directions, sides = np.sign(states[:, 1]), states[:, 0] > (states[:, 2] if m.play else 0.0)
    full = (np.abs(states[:, 2:3]) == (0.5 * m.play or 1.0)).any(axis=1)
    before, after, was_in, is_in = directions[:-1], directions[1:], sides[:-1], sides[1:]
    return Events(
        reversed=int((before * after < 0.0).sum()),
        stuck=int(((before != 0.0) & (after == 0.0)).sum()),
        released=int(((before == 0.0) & (after != 0.0)).sum()),
        contact_left=int((was_in > is_in).sum()),
        saturated=int((full[1:] > full[:-1]).sum()),
        contact_made=int((was_in < is_in).sum()),
    )


def difference(
    mechanics: Mechanics, p: BrakeParameters, currents: Floats, x0: tuple[float, float], name: str, step: float = STEP
) -> tuple[Floats, bool]:
    """Sensitivity of the samples y_1..y_n by finite differences, and whether they straddle no event.

    Central ones; a delay cannot be negative, for the start of the experiment is late then: there it is the forward
    formula of second order. An event at which a derivative jumps is a stop; if within the step one comes, goes or
    passes a sample, the direction of motion at some sample changes, and the difference is none of a smooth function.
    """
    middle = moved(mechanics, p, currents, x0)
    steps = (step, 2.0 * step) if name == "delay" else (step, -step)
    first, second = (changed(mechanics, p, currents, x0, name, by) for by in steps)
    slope = (4.0 * first - second - 3.0 * middle) if name == "delay" else (first - second)
    smooth = all((np.sign(other[1:, 1]) == np.sign(middle[1:, 1])).all() for other in (first, second))
    return (slope / (2.0 * step))[1:], smooth


def square(half_period: int, current: float) -> Floats:
    """500 samples of a square wave, positive first."""
    return np.where(np.arange(500) // half_period % 2 == 0, current, -current)


def of_euler(
    currents: Sequence[float] | Floats, params: Sequence[str] = PARAMETER_NAMES, x0: tuple[float, float] = (0.0, 0.0)
) -> Floats:
    """Sensitivities of the nominal Euler brake, shape (n, len(params), 2)."""
    return simulate(BUILT_IN["euler"], Theta(NOMINAL, x0), planned(currents), T_S, params).sensitivities


def euler_states(
    p: BrakeParameters, currents: Sequence[float] | Floats, x0: tuple[float, float] = (0.0, 0.0)
) -> Floats:
    """States of an Euler brake, shape (n + 1, 2)."""
    return simulate(BUILT_IN["euler"], Theta(p, x0), planned(currents), T_S).states


def fisher(
    bench: Bench,
    p: BrakeParameters,
    currents: Sequence[float] | Floats,
    *,
    kind: Kind,
    plant: Plant,
    params: Sequence[str] = PARAMETER_NAMES,
    nuisances: Sequence[str] = (),
    x0: tuple[float, float] = (0.0, 0.0),
    prior: Floats | None = None,
    measured: Any = None,
) -> Fisher:
    """The Fisher information that currents [A] draw from a brake, in plain Python and all at once.

    ``measured`` is False for a lost sample.
    """
    names = (*params, *nuisances)
    run = simulate(plant, Theta(p, x0), planned(currents), bench.timing.sample_time, names)
    weights = weights_along(bench, kind, plant.instruments, run.states)
    matrix = information_over_time(run.sensitivities, weights, prior, measured)[-1]
    return Fisher(kind, names, p, matrix, prior, plant.name, tuple(nuisances))
