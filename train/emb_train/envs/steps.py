"""One sample period of experiments side by side: shield, instruments, brake, information, and what the critic sees.

:func:`advance` is the one definition of a step. The scalar environment runs it as plain Python on a batch of one, the
vector environment compiled on a batch of many.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.motion import SENSITIVE, STATES
from emb_bench.brake.motion import advance as move
from emb_bench.information.fisher import Kind, weights_of
from emb_bench.information.packed import Floats, add_increment, packed_size
from emb_bench.sim.instruments import MEMORY, command, measure
from emb_runtime.config.bench import Bench, BrakeParameters
from emb_runtime.config.plants import Instruments, Mechanics
from emb_runtime.records import Reason
from emb_runtime.safety.shield import PAST, damped_current, shield
from emb_runtime.safety.shield_design import ShieldLaw
from emb_train.envs.randomisation import OWN, Bools, instruments_of, mechanics_of

Integers = NDArray[np.int64]

UNHEARD = int(Reason.MISSED)
"""What a lost sample is called among the reasons."""


class Rules(NamedTuple):
    """The constants of an experiment; floats and integers only, so that it compiles."""

    sample_time: float
    """[s]."""
    horizon: int
    """Steps in one experiment."""
    angle_low: float
    """[rad]."""
    angle_high: float
    """[rad]."""
    velocity: float
    """Largest speed [rad/s]."""
    angle_weight: float
    """Of the angle in the FIM, see :func:`emb_bench.information.fisher.weights_of`."""
    velocity_weight: float
    """Of the velocity."""
    shielded: bool
    """Whether the shield has the last word; else what is wanted is clipped to the limit."""
    damping_velocity: float
    """Of the node that brakes by itself [rad/s]; infinite for one that lets go."""


class Rows(NamedTuple):
    """N experiments with n parameters: their brakes, where they are, and all that will befall them.

    Arrays only, so that it compiles. What takes it goes on with it in place.
    """

    brakes: Floats
    """Rows of :class:`BrakeParameters`, shape [N, 6]."""
    own: Floats
    """What each has beside its plant, columns as in ``OWN``, shape [N, 5]."""
    x: Floats
    """True states, see :mod:`emb_bench.brake.motion`: angle [rad], velocity [rad/s] and two more, shape [N, 4]."""
    s: Floats
    """Sensitivities of all four to the relative parameters, shape [N, n, 4]."""
    m: Floats
    """Packed FIM, shape [N, n (n + 1) / 2]."""
    memory: Floats
    """Of the instruments, shape [N, MEMORY]."""
    y: Floats
    """Measured angle and velocity as heard last, shape [N, 2]."""
    applied: Floats
    """The current that acted in the period before, as the node said last [A], shape [N]."""
    past: Floats
    """The last sent currents, newest first [A], shape [N, PAST]; 0 where nothing was sent."""
    k: Integers
    """Step, shape [N]."""
    noise: Floats
    """Of the sensors for all samples of the experiment, shape [N, horizon + 1, 2]."""
    late: Floats
    """How much too late each of them is taken [s], shape [N, horizon + 1]."""
    lost: Bools
    """Which of them do not arrive, shape [N, horizon + 1]."""
    reasons: Integers
    """Why what was sent last is not what was wanted: :class:`emb_runtime.records.Reason` bits, shape [N]."""
    violated: Bools
    """Whether the brake is outside its limits, shape [N]."""


def no_rows(count: int, n: int, steps: int) -> Rows:
    """Rows of N experiments with n parameters that are over: each has to begin before its first step."""
    return Rows(
        brakes=np.zeros((count, len(BrakeParameters._fields))),
        own=np.zeros((count, len(OWN))),
        x=np.zeros((count, STATES)),
        s=np.zeros((count, n, SENSITIVE)),
        m=np.zeros((count, packed_size(n))),
        memory=np.zeros((count, MEMORY)),
        y=np.zeros((count, 2)),
        applied=np.zeros(count),
        past=np.zeros((count, PAST)),
        k=np.full(count, steps),
        noise=np.zeros((count, steps + 1, 2)),
        late=np.zeros((count, steps + 1)),
        lost=np.zeros((count, steps + 1), np.bool_),
        reasons=np.zeros(count, np.int64),
        violated=np.zeros(count, np.bool_),
    )


def only(rows: Rows, i: int) -> Rows:
    """One of the experiments."""
    own = slice(i, i + 1)
    return Rows(
        rows.brakes[own],
        rows.own[own],
        rows.x[own],
        rows.s[own],
        rows.m[own],
        rows.memory[own],
        rows.y[own],
        rows.applied[own],
        rows.past[own],
        rows.k[own],
        rows.noise[own],
        rows.late[own],
        rows.lost[own],
        rows.reasons[own],
        rows.violated[own],
    )


class Scale(NamedTuple):
    """What the critic's numbers are divided by, so that they are of order one."""

    middle: Floats
    """Of the range of each parameter, shape [n]."""
    half: Floats
    """Its half width, shape [n]; 1 for a parameter that does not vary."""
    columns: Integers
    """Of the n parameters in ``Rows.brakes``, shape [n]."""
    own_middle: Floats
    """Of the range of what each experiment has of its own, shape [5]."""
    own_half: Floats
    """Its half width, shape [5]; 1 for what does not vary."""
    current: float
    """Limit of the current [A]."""


def rules_of(bench: Bench, kind: Kind = "weighted", shielded: bool = True) -> Rules:
    """The constants of this bench's experiment, with this Fisher information."""
    timing, limits = bench.timing, bench.limits
    weights = weights_of(bench, kind)
    damping = bench.node.damping_velocity if bench.node.stop == "damped" else math.inf
    return Rules(timing.sample_time, timing.horizon, *limits.angle, limits.velocity, *weights, shielded, damping)


def clipped(wanted: float, limit: float) -> float:
    """A current within ±limit [A]; one that is not finite counts as 0 A, as it does for the shield."""
    return min(max(wanted, -limit), limit) if math.isfinite(wanted) else 0.0


def advance(
    law: ShieldLaw,
    rules: Rules,
    mechanics: Mechanics,
    instruments: Instruments,
    chosen: Integers,
    rows: Rows,
    wanted: Floats,
) -> None:
    """One sample period for N brakes, in place.

    Args:
        law: the shield's.
        rules: the experiment's.
        mechanics: how the brakes move.
        instruments: what lies between them and the bus.
        chosen: indices in ``UNKNOWNS`` of the n parameters, shape [n].
        rows: the experiments.
        wanted: currents asked for [A], shape [N]; without effect where the sample was lost.
    """
    brakes, own, x, s, m, memory, y, applied, past, k, noise, late, lost, reasons, violated = rows
    for i in range(k.shape[0]):
        advance_one(
            law, rules, mechanics, instruments, chosen,
            brakes, own, x, s, m, memory, y, applied, past, k, noise, late, lost, reasons, violated,
            i, float(wanted[i]),
        )  # fmt: skip


def advance_one(
    law: ShieldLaw,
    rules: Rules,
    mechanics: Mechanics,
    instruments: Instruments,
    chosen: Integers,
    brakes: Floats,
    own: Floats,
    x: Floats,
    s: Floats,
    m: Floats,
    memory: Floats,
    y: Floats,
    applied: Floats,
    past: Floats,
    k: Integers,
    noise: Floats,
    late: Floats,
    lost: Bools,
    reasons: Integers,
    violated: Bools,
    i: int,
    wanted: float,
) -> None:
    """One sample period for brake ``i``, in place. Arguments are as for :func:`advance`, the arrays those of its rows.

    They come one by one because a compiled function counts references to every array of a tuple that it is given, and
    here that takes as long as a layer of a network.
    """
    p = BrakeParameters(
        float(brakes[i, 0]),
        float(brakes[i, 1]),
        float(brakes[i, 2]),
        float(brakes[i, 3]),
        float(brakes[i, 4]),
        float(brakes[i, 5]),
    )
    moving, sensing = mechanics_of(mechanics, own, i), instruments_of(instruments, own, i)
    y1, y2 = float(y[i, 0]), float(y[i, 1])
    u1, u2, u3, u4, u5 = (
        float(past[i, 0]),
        float(past[i, 1]),
        float(past[i, 2]),
        float(past[i, 3]),
        float(past[i, 4]),
    )
    before = float(x[i, 1])
    sent, asked = 0.0, math.nan
    if lost[i, k[i]]:
        reasons[i] = UNHEARD
    elif rules.shielded:
        sent, reasons[i] = shield(law, y1, y2, wanted, (u1, u2, u3, u4, u5), int(k[i]))
        asked = sent
    else:
        sent, reasons[i] = clipped(wanted, law.current), 0
        asked = sent
    acting = command(sensing, memory[i], asked)
    if math.isnan(acting):
        acting = damped_current(before, law.current, rules.damping_velocity)
    move(moving, p, x[i], acting, rules.sample_time, chosen, s[i])
    add_increment(m[i], s[i], rules.angle_weight, rules.velocity_weight)
    k[i] += 1
    x1, x2 = float(x[i, 0]), float(x[i, 1])
    y1, y2 = measure(
        sensing,
        memory[i],
        rules.sample_time,
        x1,
        x2,
        (x2 - before) / rules.sample_time,
        float(late[i, k[i]]),
        float(noise[i, k[i], 0]),
        float(noise[i, k[i], 1]),
    )
    if not lost[i, k[i]]:
        y[i, 0], y[i, 1], applied[i] = y1, y2, acting
    past[i, 0], past[i, 1], past[i, 2], past[i, 3], past[i, 4] = sent, u1, u2, u3, u4
    violated[i] = not (rules.angle_low <= x1 <= rules.angle_high and abs(x2) <= rules.velocity)


def signed_log(value: float) -> float:
    """sign(v) log(1 + |v|): of order one for what spans many decades."""
    return math.copysign(math.log1p(abs(value)), value)


def describe(rules: Rules, scale: Scale, rows: Rows, out: NDArray[np.float32]) -> None:
    """What the critic sees (thesis Table 4.2, and the sensitivities), in fixed scales of order one, in place.

    Without the sensitivities the next increment of the FIM is not a function of the state: it would not be Markov.
    Where something is randomised beside the brake, what an experiment has of its own follows, whether its sample was
    heard, the current in its motor, and the last sent currents, which may still be on their way.

    Args:
        rules: the experiment's.
        scale: of the numbers.
        rows: the experiments.
        out: becomes x_1, x_2, k, θ, FIM, sensitivities, and the rest where there is room for it: shape
            [N, 3 + n + n (n + 1) / 2 + 2 n] or that and ``MORE``.
    """
    middle, half, columns = scale.middle, scale.half, scale.columns
    for i in range(rows.k.shape[0]):
        at = describe_one(rules, middle, half, columns, rows.brakes, rows.x, rows.s, rows.m, rows.k, i, out[i])
        if at < out.shape[1]:
            describe_own(scale, rows, i, at, out[i])


def describe_one(
    rules: Rules,
    middle: Floats,
    half: Floats,
    columns: Integers,
    brakes: Floats,
    x: Floats,
    s: Floats,
    m: Floats,
    k: Integers,
    i: int,
    out: NDArray[np.float32],
) -> int:
    """The same for experiment ``i`` without the rest, to ``out``, and how many numbers that is."""
    n = columns.shape[0]
    out[0] = x[i, 0] / rules.angle_high
    out[1] = x[i, 1] / rules.velocity
    out[2] = k[i] / rules.horizon
    at = 3
    for j in range(n):
        out[at + j] = (brakes[i, columns[j]] - middle[j]) / half[j]
    at += n
    for j in range(m.shape[1]):
        out[at + j] = 0.1 * signed_log(m[i, j])
    at += m.shape[1]
    for j in range(n):
        out[at + 2 * j] = 4.0 * s[i, j, 0] / rules.angle_high
        out[at + 2 * j + 1] = 4.0 * s[i, j, 1] / rules.velocity
    return int(at + 2 * n)


def describe_own(scale: Scale, rows: Rows, i: int, at: int, out: NDArray[np.float32]) -> None:
    """The rest of it, from ``out[at]`` on."""
    for j in range(rows.own.shape[1]):
        out[at + j] = (rows.own[i, j] - scale.own_middle[j]) / scale.own_half[j]
    at += rows.own.shape[1]
    out[at] = 0.0 if rows.lost[i, rows.k[i]] else 1.0
    out[at + 1] = rows.x[i, 3] / scale.current
    for j in range(PAST):
        out[at + 2 + j] = rows.past[i, j] / scale.current


MORE = len(OWN) + 2 + PAST
"""Numbers that the critic sees beside the others where something is randomised."""


def critic_size(n: int) -> int:
    """Length of the critic's observation for n parameters where nothing is randomised beside the brake."""
    return 3 + n + packed_size(n) + 2 * n
