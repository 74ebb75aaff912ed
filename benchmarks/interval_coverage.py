"""Coverage of the intervals, and errors of the model: noticed, named, or at least inside the intervals?

    python benchmarks/interval_coverage.py --case total [--draws 400] [--seed 1] [--method oem] [--systematic bench]

Records of random brakes within ±50 % under random excitations, from ``benchmarks.independent_simulator``, which shares
no code with the estimators. The cases are ``CASES``:

- ``repeatability``: a right model without systematic errors;
- ``total``: a right model, all systematic errors drawn from their priors in the bench file;
- ``inertia``, ``angle_scale``: only that one drawn;
- ``unlisted``: a small error of the model of one of ``UNLISTED``;
- ``unlisted-actor``: the same under the currents with which the shipped actor excites a brake without that error;
- ``drawn``: a small error of the model whose form is drawn: 20 kinds (:func:`kind_of`);
- ``prior``: errors and effects drawn from all priors;
- ``known``: a right model whose k_m was measured to 0.1 %, its inertia drawn with 5 %, the scale of the angle with its
  prior or right and excluded;
- ``near-misses``: a misspecified model: a small error of one of ``KINDS`` in one of three sizes, in turns with a
  right model;
- ``disturbance``: the velocity or the load walks at random, and the estimator does not know;
- ``losses``: 2, 5 and 10 % of the samples are lost, one by one or in bursts of 20 ms, and a fifth as many commands;
- ``charge``: the same, and the node sends the integral of its current along;
- ``sensors``: coarse encoders and slow observers. The bench file states √(σ² + step²/12) as noise of the angle.

Where J and the scale of the angle are right in all records, the bench file says so (``inertia = angle_scale = 0``), for
their priors are wide beside everything else; ``repeatability`` does so with the clock as well. A row has the records
that fit by their test, the parameters inside their 95 % intervals by total and by repeatability, the records that
fit by it with a parameter beyond 3 total deviations, and the share of noticed errors whose cause is named first.
Shares have 95 % intervals (Clopper and Pearson 1934); parameters of one record are not independent, and count as if
they were.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

sys.path.insert(0, str(Path(__file__).parents[1]))  # the simulator is a neighbour

from benchmarks.independent_simulator import ALONG, TORQUES, Brake, Floats, Losses, brake_of, simulate
from emb_bench import api
from emb_bench.analysis.conclusion import noise_deviations
from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import Plant
from emb_bench.estimate.average import SHARES
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.records import FREE, NORMAL_95, EstimationProblem
from emb_bench.experiment.experiment import Experiment
from emb_bench.experiment.from_log import read_experiment
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.numbers import in_percent

FAR = 3.0  # Stated deviations; a usable value that is further off is wrong
BURST = 20  # Samples in a burst of losses
COMMANDS = 0.2  # Commands that are lost, for each sample that is


class Drawn(NamedTuple):
    """One record, what the estimator is given, and the truth."""

    row: str
    bench: Bench
    plant: Plant
    record: Experiment
    brake: Brake
    params: tuple[str, ...] = PARAMETER_NAMES  # Parameters that are estimated
    causes: tuple[str, ...] = ()  # Suspects that lead to the remedy; none where the model is right


class Kind(NamedTuple):
    """A small error of the model."""

    error: str  # Number of the simulated brake that is not as the model has it
    sizes: tuple[float, float, float]
    unit: str
    causes: tuple[str, ...]


KINDS: Mapping[str, Kind] = {
    "encoder offset": Kind("encoder_offset", (0.002, 0.01, 0.05), "rad", ("offset", "contact")),
    "current offset": Kind("current_offset", (0.002, 0.01, 0.05), "A", ("current_offset",)),
    "delay": Kind("delay", (0.005, 0.03, 0.2), "samples", ("delay",)),
    "velocity gain": Kind("velocity_gain", (0.0005, 0.003, 0.02), "1", ("velocity_gain",)),
    "quadratic stiffness": Kind("quadratic", (3e-6, 1e-5, 1e-4), "1/rad", ("quadratic",)),
    "cubic stiffness": Kind("cubic", (3e-8, 3e-7, 3e-6), "1/rad²", ("cubic", "quadratic")),
    "play": Kind("play", (0.01, 0.05, 0.2), "rad", ("play", "hysteresis")),
    "Stribeck friction": Kind("stribeck", (0.003, 0.02, 0.1), "1", ("stribeck", "break_away")),
    "hysteresis": Kind("hysteresis", (0.0003, 0.002, 0.01), "1", ("hysteresis",)),
    "current lag": Kind("current_lag", (1e-5, 5e-5, 3e-4), "s", ("current_lag",)),
    "friction by direction": Kind("asymmetry", (0.001, 0.01, 0.05), "1", ("current_offset", "asymmetry")),
    "held stiffness": Kind("k_1", (1e-4, 1e-3, 1e-2), "1", ("k_1",)),
    "drift of k_m": Kind("k_m_drift", (0.0003, 0.003, 0.03), "1", ("k_m_drift",)),
    "drift of k_1": Kind("k_1_drift", (0.0003, 0.003, 0.03), "1", ("k_1_drift",)),
    "drift of T_c": Kind("t_c_drift", (0.003, 0.03, 0.1), "1", ("T_c_drift",)),
    "drift of f_v": Kind("f_v_drift", (0.003, 0.03, 0.1), "1", ("f_v_drift",)),
}

UNLISTED: tuple[tuple[str, dict[str, float], str, tuple[float, float, float]], ...] = (
    ("ripple, once a turn", {}, "ripple", (0.01, 0.05, 0.2)),
    ("ripple, seven times a turn", {"ripple_period": 0.9}, "ripple", (0.01, 0.05, 0.2)),
    ("friction decaying over 120 rad/s", {"stribeck_velocity": 120.0}, "stribeck", (0.003, 0.02, 0.1)),
    ("friction decaying over 180 rad/s", {"stribeck_velocity": 180.0}, "stribeck", (0.003, 0.02, 0.1)),
    ("gain of the current over its size", {}, "current_gain", (1e-4, 1e-3, 1e-2)),
    ("dead zone of the current", {}, "dead_current", (0.003, 0.02, 0.1)),
    ("drag", {}, "drag", (0.001, 0.01, 0.1)),
    ("shear thinning", {}, "thinning", (0.0003, 0.003, 0.03)),
    ("viscous friction by direction", {}, "f_v_asymmetry", (0.001, 0.01, 0.1)),
    ("friction by load at any speed", {}, "load_friction", (1e-9, 1e-8, 1e-7)),
    ("friction by place", {}, "place_friction", (0.003, 0.02, 0.1)),
    ("periodic stiffness, once a turn", {}, "stiffness_ripple", (1e-4, 1e-3, 1e-2)),
    ("periodic stiffness, every 3 turns", {"ripple_period": 20.0}, "stiffness_ripple", (1e-4, 1e-3, 1e-2)),
    ("friction that settles", {}, "t_c_settling", (0.003, 0.02, 0.1)),
    ("k_m that settles", {}, "k_m_settling", (1e-4, 1e-3, 1e-2)),
    ("drift of the current's offset", {}, "offset_drift", (0.002, 0.01, 0.05)),
    ("eccentric encoder", {}, "eccentricity", (3e-4, 3e-3, 3e-2)),
    ("velocity's gain by direction", {}, "velocity_asymmetry", (3e-4, 3e-3, 3e-2)),
    ("lag of the velocity", {}, "velocity_lag", (1e-5, 1e-4, 5e-4)),
    ("clock", {}, "clock_scale", (1e-6, 5e-6, 2e-5)),
)
"""Errors of the model for many of which no score test is made: name, what is given with it, number and sizes."""


ERRORS = {
    "offset": "encoder_offset",
    "current_offset": "current_offset",
    "delay": "delay",
    "velocity_gain": "velocity_gain",
    "inertia": "inertia",
    "angle_scale": "angle_scale",
    "time_scale": "clock_scale",
}
"""Systematic errors of a right model, and what they are in the simulator."""
LATEST = 0.85  # Largest delay that is drawn [samples]; the simulator has none below 0, so its prior is folded there


def right(bench: Bench, draws: int, seed: int, *, errors: Collection[str] = ()) -> Iterator[Drawn]:
    """Right models with some systematic errors drawn from their priors."""
    plant = bench.plant("exact")
    for at in range(seed, seed + draws):
        rng = np.random.default_rng(at)
        brake = brake_of(bench, plant, rng.uniform(0.5, 1.5, 4))
        drawn = {name: float(getattr(bench.systematic, name) * rng.standard_normal()) for name in errors}
        if "inertia" in drawn:
            drawn["inertia"] = brake.inertia * (1.0 + drawn["inertia"])
        if "delay" in drawn:
            drawn["delay"] = min(abs(drawn["delay"]), LATEST)
        brake = Brake(**(vars(brake) | {ERRORS[name]: value for name, value in drawn.items()}))
        yield Drawn("right", bench, plant, simulate(brake, bench, rng, f"seed {at}"), brake)


MEASURED = 1e-3  # Relative deviation of a k_m that was measured


def known(shipped: Bench, draws: int, seed: int) -> Iterator[Drawn]:
    """Right models whose k_m was measured."""
    plant = shipped.plant("exact")
    for at, scaled in [(at, scaled) for at in range(seed, seed + draws) for scaled in (True, False)]:
        rng = np.random.default_rng(at)
        brake = brake_of(shipped, plant, rng.uniform(0.5, 1.5, 4))
        inertia, k_m, scale = rng.standard_normal(3).tolist()
        measured = shipped.brake._replace(k_m=brake.k_m * (1.0 + MEASURED * k_m))
        systematic = replace(shipped.systematic, k_m=MEASURED)
        systematic = systematic if scaled else replace(systematic, angle_scale=0.0)
        brake = replace(
            brake, inertia=brake.inertia * (1.0 + FREE * inertia), angle_scale=systematic.angle_scale * scale
        )
        row = "angle's scale from its prior" if scaled else "angle's scale right"
        bench = replace(shipped, brake=measured, systematic=systematic)
        yield Drawn(row, bench, plant, simulate(brake, bench, rng, f"seed {at}"), brake)


def near_misses(bench: Bench, draws: int, seed: int) -> Iterator[Drawn]:
    """Wrong models and right ones in turns."""
    plant = bench.plant("exact")
    for name, kind in KINDS.items():
        fixed = kind.error if kind.error in PARAMETER_NAMES else None  # estimated by nobody
        for size in kind.sizes:
            for _ in range(draws):
                rng = np.random.default_rng(seed)
                factors = rng.uniform(0.5, 1.5, 4)
                if fixed:
                    factors[PARAMETER_NAMES.index(fixed)] = 1.0 + size
                brake = brake_of(bench, plant, factors)
                wrong = brake if fixed else Brake(**(vars(brake) | {kind.error: size}))
                record = simulate(wrong, bench, rng, f"seed {seed}")
                params = tuple(p for p in PARAMETER_NAMES if p != fixed)
                yield Drawn(f"{name}, {size:.2g} {kind.unit}", bench, plant, record, wrong, params, kind.causes)
                rng = np.random.default_rng(seed + 1)
                right = brake_of(bench, plant, rng.uniform(0.5, 1.5, 4))
                yield Drawn("right", bench, plant, simulate(right, bench, rng, f"seed {seed + 1}"), right)
                seed += 2


def actor_currents(brake: Brake, seed: int) -> Floats:
    """Currents of a simulated run with the shipped actor on a brake that the model describes [A]."""
    parameters = {"k_m": brake.k_m, "k_1": brake.k_1, "T_c": brake.t_c, "f_v": brake.f_v}
    return read_experiment(api.simulate(parameters=parameters, seed=seed)).currents


def unlisted(bench: Bench, draws: int, seed: int, *, actor: bool = False) -> Iterator[Drawn]:
    """Wrong models of the kinds in ``UNLISTED``, ``draws`` of each size; with the shipped actor's currents if so."""
    plant = bench.plant("exact")
    for name, given, error, sizes in UNLISTED:
        for at in range(seed, seed + draws * len(sizes)):
            rng = np.random.default_rng(at)
            sign = 1.0 if error in {"dead_current", "velocity_lag", "load_friction"} else float(rng.choice((-1.0, 1.0)))
            right = brake_of(bench, plant, rng.uniform(0.5, 1.5, 4))
            wrong = Brake(**(vars(right) | given | {error: sign * sizes[at % len(sizes)]}))
            record = simulate(wrong, bench, rng, f"seed {at}", planned=actor_currents(right, at) if actor else None)
            yield Drawn(name, bench, plant, record, wrong)
        seed += draws * len(sizes)


BENT: Mapping[str, tuple[tuple[str, ...], float]] = {
    "k_m": (("place", "current", "time"), 0.01),
    "k_1": (("load", "time"), 0.01),
    "T_c": (("place", "velocity", "speed", "load", "time"), 0.1),
    "f_v": (("place", "velocity", "speed", "load", "time"), 0.1),
}
"""Numbers that each torque may change with, and its largest share."""
BEYOND = {
    ("T_c", "velocity"),
    ("T_c", "speed"),
    ("f_v", "velocity"),
    ("f_v", "speed"),
    ("k_m", "current"),
    ("k_1", "load"),
}
"""Decays of what is special at small speeds, currents or loads: the parameter is meant beyond them."""
FORM = 401  # Points of a form, from -1 to 1
SMALL = 3e-3  # The smallest size of an error over the largest


def kind_of(seed: int) -> tuple[str, dict[str, float], Floats, float]:
    """A kind of error that is drawn: its name, what is given with it, its form of size 1, its largest size.

    A parameter is meant at rest, at the origin, without load or current, or in the middle of the run; but see
    ``BEYOND``.
    """
    rng = np.random.default_rng([seed, 7])
    torque = str(rng.choice(list(BENT)))
    along = str(rng.choice(BENT[torque][0]))
    u = np.linspace(-1.0, 1.0, FORM)
    place, width, waves, phase = (
        rng.uniform(0.2, 0.9),
        rng.uniform(0.04, 0.4),
        rng.uniform(0.3, 12.0),
        rng.uniform(0, 6),
    )
    power = rng.uniform(0.5, 3.0)
    knots = rng.standard_normal(9)
    signed = np.sign(u) if along in {"place", "velocity", "current"} and rng.random() < 0.5 else 1.0
    wave, soft = np.sin(math.pi * waves * u + phase), np.interp(u, np.linspace(-1.0, 1.0, 9), knots)
    forms = {
        "power": signed * np.abs(u) ** power,
        "decay": signed * np.exp(-((np.abs(u) / width) ** power)),
        "bump": signed * np.exp(-(((np.abs(u) - place) / width) ** 2)),
        "step": signed * 0.5 * (1.0 + np.tanh((np.abs(u) - place) / width)),
        "wave": wave,
        "line with bends": soft,
    }
    name = str(rng.choice([each for each in forms if along != "time" or each != "wave"]))
    form = forms[name]
    if name != "decay" or (torque, along) not in BEYOND:
        form = form - form[3 * FORM // 4 if along == "time" else FORM // 2]
    given = {"bent": float(TORQUES.index(torque)), "along": float(ALONG.index(along))}
    return f"{torque} by {along}, {name}", given, form / np.abs(form).max(), BENT[torque][1]


def drawn_kinds(bench: Bench, draws: int, seed: int) -> Iterator[Drawn]:
    """Wrong models of 20 kinds that are drawn, ``draws`` of each."""
    plant = bench.plant("exact")
    for kind in range(seed, seed + 20):
        name, given, form, largest = kind_of(kind)
        for at in range(draws):
            rng = np.random.default_rng([kind, at])
            size = largest * SMALL ** rng.random() * rng.choice((-1.0, 1.0))
            right = brake_of(bench, plant, rng.uniform(0.5, 1.5, 4))
            wrong = Brake(**(vars(right) | given | {"form": tuple(size * form)}))
            yield Drawn(f"{kind}: {name}", bench, plant, simulate(wrong, bench, rng, f"seed {kind}, {at}"), wrong)


EXPECTED = 1.0 / 6.0  # Share of the brakes that have a certain effect
ALWAYS_POSITIVE = {"delay", "hysteresis", "play", "f_l", "current_lag", "dead_current", "break_away"}


def prior(bench: Bench, draws: int, seed: int) -> Iterator[Drawn]:
    """Brakes as we expect them: each error and effect is there in one of six, at any of the sizes of its prior."""
    plant, priors = bench.plant("exact"), bench.systematic
    same = ("quadratic", "cubic", "hysteresis", "play", "f_l", "current_lag", "ripple", "stiffness_ripple", "drag")
    fields = {name: name for name in (*same, "current_gain", "dead_current")}
    fields |= {name: ERRORS[name] for name in ("offset", "current_offset", "delay", "velocity_gain")}
    for at in range(seed, seed + draws):
        rng = np.random.default_rng(at)
        brake = brake_of(bench, plant, rng.uniform(0.5, 1.5, 4))

        def size(name: str, deviation: float, rng: np.random.Generator = rng) -> float:
            drawn = float(deviation * rng.choice(SHARES) * rng.standard_normal() * (rng.random() < EXPECTED))
            return abs(drawn) if name in ALWAYS_POSITIVE else drawn

        drawn = {field: size(name, getattr(priors, name)) for name, field in fields.items()}
        drawn |= {f"{name.lower()}_drift": size("drift", priors.drift) for name in PARAMETER_NAMES}
        friction, speed = [("break_away", 30.0), ("slow_friction", 100.0), ("slow_friction", 200.0)][rng.integers(3)]
        drawn |= {"stribeck": size(friction, getattr(priors, friction)), "stribeck_velocity": speed}
        drawn["delay"] = min(drawn["delay"], LATEST)
        drawn["inertia"] = brake.inertia * (1.0 + priors.inertia * rng.standard_normal())
        drawn["angle_scale"] = priors.angle_scale * rng.standard_normal()
        drawn["clock_scale"] = priors.time_scale * rng.standard_normal()
        brake = Brake(**(vars(brake) | drawn))
        yield Drawn("prior", bench, plant, simulate(brake, bench, rng, f"seed {at}"), brake)


WALKS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("nothing", {}),
    ("velocity, 3 rad/s per √s", {"velocity_walk": 3.0}),
    ("velocity, 10 rad/s per √s", {"velocity_walk": 10.0}),
    ("velocity, 30 rad/s per √s", {"velocity_walk": 30.0}),
    ("load, 1 mN·m per √s", {"torque_walk": 1e-3}),
    ("load, 5 mN·m per √s", {"torque_walk": 5e-3}),
)


def disturbance(bench: Bench, draws: int, seed: int) -> Iterator[Drawn]:
    """Random walks of velocity and load."""
    plant = bench.plant("exact")
    for name, walk in WALKS:
        for _ in range(draws):
            factors = np.random.default_rng([seed, 1]).uniform(0.5, 1.5, 4)
            brake = replace(brake_of(bench, plant, factors), **walk)
            record = simulate(brake, bench, np.random.default_rng(seed), f"seed {seed}")
            yield Drawn(name, bench, plant, record, brake)
            seed += 1


def losses(bench: Bench, draws: int, seed: int, *, charge: bool) -> Iterator[Drawn]:
    """Lost samples and commands of right brakes."""
    plant, n = bench.plant("exact"), bench.timing.horizon
    for burst in (1, BURST):
        for lost in (0.02, 0.05, 0.1):
            for _ in range(draws):
                rng = np.random.default_rng(seed)
                brake = brake_of(bench, plant, rng.uniform(0.5, 1.5, 4))
                pattern = Losses(_lost_samples(lost, burst, n, rng), rng.random(n) < COMMANDS * lost)
                record = simulate(brake, bench, rng, f"seed {seed}", pattern, charge=charge)
                yield Drawn(f"{100 * lost:.0f} %, {burst} ms at a time", bench, plant, record, brake)
                seed += 1


def _lost_samples(lost: float, burst: int, n: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    if burst == 1:
        return rng.random(n) < lost
    samples = np.zeros(n, np.bool_)
    for begin in rng.integers(0, n - burst, rng.poisson(lost * n / burst)):
        samples[begin : begin + burst] = True
    return samples


class Sensors(NamedTuple):
    """Angle and velocity as a bench has them."""

    counts: int  # Of the encoder per revolution; 0 for one that does not round
    noise: float  # Of the angle before it is rounded [rad]
    observer: float = 0.0  # Bandwidth of the observer [rad/s]; 0 where the velocity is measured


SENSORS: Mapping[str, Sensors] = {
    "4096 counts, noise of 1 mrad": Sensors(4096, 1e-3),
    "4096 counts, noise of 0.1 mrad": Sensors(4096, 1e-4),
    "1024 counts, noise of 0.1 mrad": Sensors(1024, 1e-4),
    "observer of 300 rad/s": Sensors(0, 1e-3, 300.0),
    "observer of 100 rad/s": Sensors(0, 1e-3, 100.0),
    "observer of 300 rad/s, 4096 counts, noise of 0.1 mrad": Sensors(4096, 1e-4, 300.0),
}


def sensors(shipped: Bench, draws: int, seed: int) -> Iterator[Drawn]:
    """Coarse encoders and slow observers."""
    for name, shown in SENSORS.items():
        step = 2.0 * math.pi / shown.counts if shown.counts else 0.0
        moved = replace(shipped, noise=replace(shipped.noise, angle=shown.noise))
        stated = replace(shipped, noise=replace(shipped.noise, angle=math.hypot(shown.noise, step / math.sqrt(12.0))))
        plant = shipped.plant("observer" if shown.observer else "exact")
        plant = replace(plant, instruments=plant.instruments._replace(observer_bandwidth=shown.observer))
        for _ in range(draws):
            rng = np.random.default_rng(seed)
            brake = replace(brake_of(shipped, plant, rng.uniform(0.5, 1.5, 4)), encoder_step=step)
            yield Drawn(name, stated, plant, simulate(brake, moved, rng, f"seed {seed}"), brake)
            seed += 1


CASES: Mapping[str, Callable[[Bench, int, int], Iterator[Drawn]]] = {
    "repeatability": right,
    "total": partial(right, errors=tuple(ERRORS)),
    "inertia": partial(right, errors=("inertia",)),
    "angle_scale": partial(right, errors=("angle_scale",)),
    "known": known,
    "near-misses": near_misses,
    "unlisted": unlisted,
    "unlisted-actor": partial(unlisted, actor=True),
    "drawn": drawn_kinds,
    "prior": prior,
    "disturbance": disturbance,
    "losses": partial(losses, charge=False),
    "charge": partial(losses, charge=True),
    "sensors": sensors,
}


class Outcome(NamedTuple):
    """Answer to one record beside the truth."""

    drawn: Drawn
    fits: bool
    errors: Floats  # Of the parameters [total deviations]
    totals: Floats  # Half of their 95 % intervals, relative
    largest: float  # Of their errors, relative
    over_bound: Floats  # The same [Cramér-Rao bounds]
    covered: NDArray[np.bool_]  # By total
    repeats: NDArray[np.bool_]  # By repeatability
    suspect: str
    seconds: float

    @property
    def far(self) -> bool:
        """True if it is called usable and a parameter is wrong."""
        return self.fits and bool(np.max(np.abs(self.errors)) > FAR)


def judge(drawn: Drawn, method: str, *, systematic: bool) -> Outcome:
    """The estimate as the command makes it, beside the truth."""
    problem = EstimationProblem(drawn.params)
    problem = with_systematic(problem, drawn.bench, drawn.plant) if systematic else problem
    begin = time.perf_counter()
    e = method_of(method)(drawn.bench, drawn.plant, problem).fit([drawn.record])
    seconds = time.perf_counter() - begin
    b = drawn.brake
    true = {"k_m": b.k_m, "k_1": b.k_1, "T_c": b.t_c, "f_v": b.f_v}
    index = [i for i, u in enumerate(e.unknowns) if u.name in drawn.params]
    truths = np.array([true[e.unknowns[i].name] for i in index])
    low, high = e.intervals()[index].T
    errors = e.values[index] / truths - 1.0
    repeats = np.abs(errors) <= NORMAL_95 * noise_deviations(e)[index]
    suspects = e.validation.suspects
    name = suspects[0].name if suspects else ""
    return Outcome(
        drawn,
        e.validation.fits,
        errors / e.deviations()[index],
        NORMAL_95 * e.deviations()[index],
        float(np.max(np.abs(errors))),
        errors / e.cramer_rao()[index],
        (low <= truths) & (truths <= high),
        repeats,
        name,
        seconds,
    )


def share(part: int, of: int) -> str:
    """A share with its 95 % interval (Clopper and Pearson 1934)."""
    if of == 0:
        return "none of 0"
    low, high = stats.binomtest(part, of).proportion_ci(method="exact")
    return f"{part} of {of} = {100 * part / of:.1f} % ({100 * low:.1f} to {100 * high:.1f} %)"


def report(row: str, outcomes: list[Outcome]) -> None:
    """One row of the table."""
    fits = [o for o in outcomes if o.fits]
    covered, repeats = (np.concatenate([getattr(o, name) for o in outcomes]) for name in ("covered", "repeats"))
    print(f"\n{row}: {len(outcomes)} records")
    print("  fits                            ", share(len(fits), len(outcomes)))
    print("  covered by total                ", share(int(covered.sum()), covered.size))
    print("  covered by repeatability        ", share(int(repeats.sum()), repeats.size))
    print("  median of the largest error      ", in_percent(np.median([o.largest for o in outcomes])))
    print("  fits, a parameter beyond 3 dev. ", share(sum(o.far for o in outcomes), len(fits)))
    if fits:
        print(f"  largest error of those that fit  {max(np.max(np.abs(o.errors)) for o in fits):.1f} deviations")
    noticed = [o for o in outcomes if o.drawn.causes and not o.fits]
    if noticed:
        named = sum(o.suspect in o.drawn.causes for o in noticed)
        print("  cause named first, where noticed", share(named, len(noticed)))
    if len({o.drawn.params for o in outcomes}) == 1 and len(outcomes) > 1:
        params, errors = outcomes[0].drawn.params, np.array([o.errors for o in outcomes])
        half = 1.96 * errors.std(axis=0, ddof=1) / math.sqrt(len(errors))
        pairs = zip(params, errors.mean(axis=0), half, strict=True)
        print("  mean error [deviations]         ", ", ".join(f"{name} {m:+.2f} ± {h:.2f}" for name, m, h in pairs))
        totals = zip(params, np.median([o.totals for o in outcomes], axis=0), strict=True)
        print("  median total (k = 2)            ", ", ".join(f"{name} {in_percent(t)}" for name, t in totals))
        squares = zip(params, np.mean([o.over_bound**2 for o in outcomes], axis=0), strict=True)
        print("  mean square error over the bound", ", ".join(f"{name} {s:.3g}" for name, s in squares))
    print(f"  seconds of an estimate           median {np.median([o.seconds for o in outcomes]):.3f}")


def main() -> None:
    """Print the table of a case."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--case", choices=CASES, required=True)
    parser.add_argument("--draws", type=int, default=4, help="records of each row (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the first record (default: %(default)s)")
    parser.add_argument("--method", default="oem", choices=("oem", "pem"), help="default: %(default)s")
    parser.add_argument("--systematic", choices=("bench", "none"), default="bench", help="default: %(default)s")
    args = parser.parse_args()
    print(f"{args.case}: seeds from {args.seed}, method {args.method}, systematic errors {args.systematic}")
    outcomes: dict[str, list[Outcome]] = {}
    bench = load_bench()
    if args.case not in {"total", "inertia", "angle_scale", "prior", "known"}:
        bench = replace(bench, systematic=replace(bench.systematic, inertia=0.0, angle_scale=0.0))
    if args.case == "repeatability":
        bench = replace(bench, systematic=replace(bench.systematic, time_scale=0.0))
    for drawn in CASES[args.case](bench, args.draws, args.seed):
        outcomes.setdefault(drawn.row, []).append(judge(drawn, args.method, systematic=args.systematic == "bench"))
    for row, found in outcomes.items():
        report(row, found)
    every = [o for found in outcomes.values() for o in found]
    wrong = [o for o in every if o.drawn.causes]
    if wrong:
        report("all that are wrong", wrong)
    report("all", every)
    fits = [o for o in every if o.fits]
    covered = np.concatenate([o.repeats if args.case == "repeatability" else o.covered for o in every])
    far, what = share(sum(o.far for o in every), len(fits)), f"{args.case}, {len(every)} records, seed {args.seed}"
    print(f"| {what}: parameters covered | 93 to 97 % | {share(int(covered.sum()), covered.size)} |")
    print(f"| {what}: fits, and a parameter beyond {FAR:g} total deviations | 1 % | {far} |")
    if noticed := [o for o in wrong if not o.fits]:
        named = share(sum(o.suspect in o.drawn.causes for o in noticed), len(noticed))
        print(f"| {what}: the cause named first, where noticed | 80 % | {named} |")


if __name__ == "__main__":
    main()
