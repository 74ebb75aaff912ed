"""The thesis's figures, drawn from this project's numbers; those of chapters 3 to 5.1 need no training.

Figures without numbers are left out: the brake (3.1), and the diagrams of the learning (4.4 to 4.6).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from emb_bench.brake.forces import clamping_force, decay, sliding_torque
from emb_bench.config.bench import Bench
from emb_bench.config.plants import Mechanics
from emb_bench.figures import DASHED, drawn
from emb_bench.information.symmetric import Floats
from studies.thesis.determinant import AMPLITUDE, EPSILON, protected, unprotected
from studies.thesis.oscillator import SWITCH, inputs
from studies.thesis.two_parameters import FASTEST, excited

if TYPE_CHECKING:  # torch takes its time
    from studies.thesis.trainings import Training, Trainings, Trajectories

SAMPLES = 400  # Points of a curve
DRAWS = 5000  # Parameters of a histogram
SIZE = (8.0, 6.0)  # inch


def friction(bench: Bench, path: Path, name: str) -> None:
    """Fig. 3.3: Stribeck friction; Fig. 3.5: the simplified friction."""
    mechanics = bench.plant("stribeck").mechanics if name == "fig-3.3" else Mechanics()
    speed = np.linspace(-100.0, 100.0, SAMPLES)  # without 0, where friction has no sign
    torque = [
        np.sign(v) * sliding_torque(mechanics, bench.brake, abs(v), 0.0, decay(mechanics, v)) for v in speed.tolist()
    ]
    with _one(path, name) as axes:
        axes.plot(speed, 1e3 * np.array(torque))
        axes.set(xlabel="velocity [rad/s]", ylabel="friction torque [mN·m]")


def stiffness(bench: Bench, path: Path, name: str) -> None:
    """Fig. 3.2: hysteresis of the clamping force; Fig. 3.4: a cubic and the linear one."""
    angle = np.linspace(0.0, bench.limits.angle[1], SAMPLES)
    plant, sides = ("hysteresis", {"applying": 1.0, "releasing": -1.0})
    if name == "fig-3.4":
        plant, sides = "cubic", {"cubic": 0.0}
    with _one(path, name) as axes:
        for label, side in sides.items():
            mechanics = bench.plant(plant).mechanics
            axes.plot(angle, [clamping_force(mechanics, bench.brake, x, side) for x in angle.tolist()], label=label)
        if name == "fig-3.4":
            axes.plot(angle, bench.brake.k_1 * angle, label="linear, k_1 x_1")
        axes.set(xlabel="angle [rad]", ylabel="clamping force [N]")
        axes.legend()


def ellipses(bench: Bench, path: Path, name: str) -> None:
    """Fig. 4.1: the 95 % confidence ellipses of f_v and k_1 for two excitations, and what D, A and E are of them."""
    with _one(path, name) as axes:
        for text in (FASTEST, "square"):
            run = excited(bench, text)
            covariance: Floats = np.asarray(np.linalg.inv(run.fim), np.float64)
            edge = ellipse(covariance)
            area, trace = np.pi * np.sqrt(np.linalg.det(covariance)), float(np.trace(covariance))
            longest = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
            label = f"{run.name}: area {area:.2g} (D), trace {trace:.2g} (A), half axis {longest:.2g} (E)"
            axes.plot(*edge, label=label)
        axes.set(xlabel="error of f_v, relative", ylabel="error of k_1, relative")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12))


def ellipse(covariance: Floats, quantile: float = 5.991) -> Floats:
    """Edge of a confidence region in two dimensions, shape [2, SAMPLES]; the quantile is that of χ² for 95 %."""
    turn = np.linspace(0.0, 2.0 * np.pi, SAMPLES)
    edge: Floats = np.sqrt(quantile) * np.linalg.cholesky(covariance) @ np.array([np.cos(turn), np.sin(turn)])
    return edge


def determinants(bench: Bench, path: Path, name: str) -> None:
    """Fig. 4.2: the FIM under a constant current; Fig. 4.3: begun at ε I and normalised."""
    f = unprotected(bench, AMPLITUDE)
    times = bench.timing.sample_time * np.arange(1, len(f.conditions) + 1)
    if name == "fig-4.2":
        dets, conditions = f.determinants_single, f.conditions_single
        with np.errstate(invalid="ignore", divide="ignore"):
            logs = np.log(dets)  # NaN where it is negative: the gaps
    else:
        cured = protected(bench, AMPLITUDE, EPSILON)
        dets, logs, conditions = np.exp(cured.log_normalised), cured.log_det, cured.conditions
    panels = (
        ("current [A]", np.full(len(times), f.amplitude)),
        ("angle [rad]", f.states[1:, 0]),
        ("velocity [rad/s]", f.states[1:, 1]),
        ("|M|", dets),
        ("log |M|", logs),
        ("condition number", conditions),
    )
    with drawn(path, 3, 2, name, SIZE, sharex=True) as axes:
        for panel, (label, values) in zip(axes.T.flat, panels, strict=True):
            panel.plot(times, values)
            panel.set(ylabel=label)
        axes[2, 1].set(yscale="log")
        for panel in axes[2]:
            panel.set(xlabel="time [s]")


def distributions(bench: Bench, path: Path, name: str) -> None:
    """Fig. 4.7: the brakes that a training draws, uniformly and normally."""
    from emb_train.closed_loop import drawn as draw

    ranges = bench.range_set("viscous")
    with _one(path, name) as axes:
        for how in ("uniform", "normal"):
            rng = np.random.default_rng(0)
            values = [draw(ranges, rng, how)[5] for _ in range(DRAWS)]
            axes.hist(values, bins=40, histtype="step", label=how)
        axes.set(xlabel="f_v [N·m·s/rad]", ylabel=f"of {DRAWS} brakes")
        axes.legend()


def sensitivities(bench: Bench, path: Path, name: str) -> None:
    """Fig. 5.1: two velocities, the sensitivities that they drive, and the increments of the FIM."""
    times = bench.timing.sample_time * np.arange(1, bench.timing.horizon + 1)
    labels = ("velocity [rad/s]", "a [rad]", "b [rad/s]", "increment of M")
    with drawn(path, 4, 1, name, SIZE, sharex=True) as axes:
        for which, driven in enumerate(inputs(bench), 1):
            for panel, values in zip(
                axes[:, 0], (driven.velocity, driven.s[:, 0], driven.s[:, 1], driven.increments), strict=True
            ):
                panel.plot(times, values, label=f"input {which}")
        for panel, label in zip(axes[:, 0], labels, strict=True):
            panel.set(ylabel=label)
            panel.axvline(SWITCH, **DASHED)
        axes[0, 0].legend()
        axes[3, 0].set(xlabel="time [s]")


ANALYSIS: Mapping[str, Callable[[Bench, Path, str], None]] = {
    "fig-3.2": stiffness,
    "fig-3.3": friction,
    "fig-3.4": stiffness,
    "fig-3.5": friction,
    "fig-4.1": ellipses,
    "fig-4.2": determinants,
    "fig-4.3": determinants,
    "fig-4.7": distributions,
    "fig-5.1": sensitivities,
}
"""Figures that need no training."""
EXPERIMENTS = {
    "fig-5.3": "thesis-fixed",
    "fig-5.4": "thesis-random",
    "fig-5.6": "thesis-adaptive",
    "fig-5.8": "thesis-trajectory-b",
    "fig-6.2": "thesis-e-optimal-trajectory",
    "fig-6.3": "thesis-e-optimal-hybrid",
}
"""Figures of five experiments of an agent, by its preset."""
CURVES = {"fig-5.2": "thesis-fixed", "fig-5.9": "thesis-trajectory-b"}
TRAINED = (*sorted((*EXPERIMENTS, *CURVES, "fig-5.5", "fig-5.7", "fig-6.1")),)
"""Figures of trained agents."""


def draw_trained(trainings: Trainings, path: Path, name: str) -> None:
    """One of :data:`TRAINED`."""
    from emb_train.play import fresh_draws
    from studies.thesis import agents

    if name in EXPERIMENTS:
        training = trainings.first(EXPERIMENTS[name])
        _courses(path, name, training, {"": agents.five(training)})
    elif name in CURVES:
        every = trainings.all(CURVES[name]) if name == "fig-5.9" else [trainings.first(CURVES[name])]
        curves = np.array([agents.smoothed(training.curve) for training in every])
        steps = every[0].config.ppo.batch * np.arange(1, curves.shape[1] + 1)
        with _one(path, name) as axes:
            axes.plot(steps, curves.mean(axis=0))
            if len(curves) > 1:
                error = curves.std(axis=0, ddof=1) / np.sqrt(len(curves))
                axes.fill_between(steps, curves.mean(axis=0) - error, curves.mean(axis=0) + error, alpha=0.3)
            axes.set(xlabel="steps of the training", ylabel=f"return, mean of {len(curves)} seeds, smoothed")
    elif name == "fig-5.5":
        with _one(path, name) as axes:
            for preset in ("thesis-fixed", "thesis-random"):
                training = trainings.first(preset)
                ranges = training.bench.range_set("viscous")
                values = np.linspace(ranges.low.f_v, ranges.high.f_v, 40)
                axes.plot(values, agents.on_grid(training).returns, "o-", markersize=3, label=preset)
            axes.axvline(trainings.first("thesis-fixed").bench.brake.f_v, **DASHED)
            axes.set(xlabel="f_v [N·m·s/rad]", ylabel="return")
            axes.legend()
    elif name == "fig-5.7":
        planned, taken = agents.ways_home(trainings.first("thesis-trajectory-b"))
        with drawn(path, 2, 1, name, SIZE, sharex=True) as axes:
            for output, label in enumerate(("angle [rad]", "velocity [rad/s]")):
                axes[output, 0].plot(planned[:, :, output], color="C0")
                axes[output, 0].plot(taken[:, :, output], color="C1")
                axes[output, 0].set(ylabel=f"{label}: plan blue, taken orange")
            axes[1, 0].set(xlabel="steps since 300 ms")
    else:
        first, second = (trainings.first(f"thesis-d-optimal-{i}") for i in (1, 2))
        draws = fresh_draws(first.bench.range_set(first.config.ranges), agents.EVALUATION_SEED, 1)
        wanted: Mapping[str, Any] = {
            "method 1": first.agent,
            "method 2": second.agent,
            "square wave": agents.square_wave,
        }
        _courses(path, name, first, {label: first.run(draws, agent) for label, agent in wanted.items()})


def _courses(path: Path, name: str, training: Training, runs: Mapping[str, Trajectories]) -> None:
    """Currents, angles and velocities of experiments."""
    limits = training.bench.limits
    with drawn(path, 3, 1, name, SIZE, sharex=True) as axes:
        for which, (label, run) in enumerate(runs.items()):
            colour = {"color": f"C{which}"} if len(runs) > 1 else {}
            for panel, values in zip(axes[:, 0], (run.current, run.x[:, :, 0], run.x[:, :, 1]), strict=True):
                lines = panel.plot(values, **colour)
                lines[0].set_label(label or None)
        for panel, text, edges in (
            (axes[0, 0], "current [A]", (-limits.current, limits.current)),
            (axes[1, 0], "angle [rad]", limits.angle),
            (axes[2, 0], "velocity [rad/s]", (-limits.velocity, limits.velocity)),
        ):
            panel.set(ylabel=text)
            for edge in edges:
                panel.axhline(edge, **DASHED)
        if len(runs) > 1:
            axes[0, 0].legend()
        axes[2, 0].set(xlabel="step")


@contextmanager
def _one(path: Path, name: str) -> Iterator[Any]:
    """A figure with one pair of axes."""
    with drawn(path, 1, 1, name, (6.0, 4.5)) as axes:
        yield axes[0, 0]
