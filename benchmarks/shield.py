"""What the envelope shield guarantees and what it costs: the figures of docs/shield.md.

    python benchmarks/shield.py [--episodes 100000] [--seed 0]

Searches for violations with adversarial episodes on two brakes (forward Euler and a finer one with an exact
standstill), breaks each assumption in turn to show that the search can fail, samples the induction step, measures what
a freewheeling node would do, and compares the information of fixed inputs with a shield that knows the brake.
"""

from __future__ import annotations

import argparse
import sys
import timeit
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # the search lives with the tests

from emb_bench.brake.euler import sensitivity_step, step
from emb_bench.compiled import compiled
from emb_bench.information import thesis_weights
from emb_runtime.bench import PARAMETER_NAMES, Bench, BrakeParameters, Ranges, load_bench
from emb_runtime.shield import ShieldLaw, chatter_excess, damped_excess, make_law, shield
from tests.properties.shield_search import (
    CRUISE_HOME,
    CRUISE_OUT,
    DROPS,
    END_ANGLE,
    END_VELOCITY,
    FASTEST,
    HIGHEST,
    LAST_SPEED,
    LOWEST,
    SLOWEST,
    Floats,
    Found,
    draw_brakes,
    induction,
    search,
)


def bench_for(ranges: str, ages: tuple[int, int] = (0, 0)) -> Bench:
    """The shipped bench with another set and other frame ages for its shield; ``known`` is the nominal brake alone."""
    bench = load_bench()
    known = Ranges("known", bench.brake, bench.brake)
    return replace(
        bench,
        ranges={**bench.ranges, "known": known},
        shield=replace(bench.shield, ranges=ranges, frame_age=ages),
    )


def report(label: str, found: Found) -> None:
    """One line of a table of :func:`table`."""
    r, told = found.rows, found.obeyed
    line = (
        f"{label:44s} {len(r):8d} {int(found.violated.sum()):9d}   {r[:, LOWEST].min():7.2f} {r[:, HIGHEST].max():7.2f}"
    )
    line += f"   {r[:, SLOWEST].min():7.1f} {r[:, FASTEST].max():6.1f}"
    if told.any():
        away = int((~found.home[told]).sum())
        line += f"   {away:6d}/{int(told.sum()):<7d} {np.abs(r[told, END_ANGLE]).max():6.3f}"
        line += f" {np.abs(r[told, END_VELOCITY]).max():6.2f}"
    print(line, flush=True)


def table(title: str) -> None:
    """Head of a table of searches."""
    print(f"\n{title}")
    print(
        f"{'':44s} {'episodes':>8s} {'violating':>9s}   {'angle [rad]':>15s}   {'velocity [rad/s]':>14s}   "
        f"{'not home':>14s} {'worst end':>13s}"
    )


def show_search(n: int, seed: int) -> None:
    """The law under its own assumptions."""
    table("Search with the law's own assumptions (half of the age-0 episodes lose commands)")
    found = search(bench_for("envelope"), n, seed)
    report("envelope", found)
    for name in ("pm50", "viscous", "viscous-stiffness", "known"):
        report(name, search(bench_for(name), n // 5, seed))
    for ages in ((0, 1), (1, 1), (0, 3), (3, 3)):
        report(f"envelope, frame ages {ages[0]}..{ages[1]}", search(bench_for("envelope", ages), n // 5, seed))
    print("\nHome in spite of lost commands (envelope), share of episodes:")
    print("  " + ", ".join(f"{d} {found.home[found.of(d)].mean():.3f}" for d in DROPS))


def show_broken(n: int, seed: int) -> None:
    """Each assumption broken in turn."""
    bench = bench_for("envelope")
    law = make_law(bench)
    table("Search with an assumption broken (violations must be found)")
    careless = law._replace(bottom=law.bottom - 0.3, top=law.top + 0.3)
    report("brake outside the set (viscous, envelope)", search(bench_for("viscous"), n, seed, truth="envelope"))
    report("no angle margin", search(bench, n, seed, law=careless))
    report("frames one period late", search(bench, n, seed, ages=(0, 1)))
    found = search(bench, n, seed, drops=("killed",), freewheel=True)
    report("freewheel after a kill", found)
    for stop, column, limit in (("lower", LOWEST, -10.0), ("upper", HIGHEST, 100.0)):
        hit = found.rows[:, column] < limit if limit < 0.0 else found.rows[:, column] > limit
        speed = found.rows[hit, LAST_SPEED].max() if hit.any() else 0.0
        print(f"  freewheel: {hit.mean():.1%} of the kills run into the {stop} stop, with up to {speed:.0f} rad/s")


def show_induction(n: int, seed: int) -> None:
    """States of the safe set that one step takes out of it."""
    print("\nOne step of the induction: states of the safe set that leave it")
    for name in ("envelope", "pm50", "viscous", "viscous-stiffness"):
        bench = bench_for(name)
        law = make_law(bench)
        excess = damped_excess(law.motor_low, law.friction_low, law.current, law.damping_velocity, law.sample_time)
        chatter = chatter_excess(law.friction_low, law.friction_high, law.sample_time)
        rng = np.random.default_rng(seed)
        tried = left = 0
        for _ in range(max(1, n // 500_000)):
            failed = np.zeros(500_000, dtype=np.bool_)
            brakes = draw_brakes(rng, bench.range_set(name), len(failed))
            tried += compiled(induction)(law, excess, chatter, brakes, rng.random((len(failed), 10)), failed)
            left += int(failed.sum())
        print(f"  {name:20s} {left} of {tried}; margin used: damped stop {excess:.3f} rad, chatter {chatter:.3f} rad")


def flown(
    law: ShieldLaw, p: BrakeParameters, switch: int, noise: Floats, weights: tuple[float, float], out: Floats
) -> None:
    """Full current, reversed at ``switch``, into the shield: weighted information on each parameter, and the state."""
    for i in range(noise.shape[0]):
        for j in range(4):
            x = v = s1 = s2 = 0.0
            total = 0.0
            for k in range(law.steps):
                wanted = law.current if k < switch else -law.current
                u, _ = shield(law, x + noise[i, k, 0], v + noise[i, k, 1], wanted, 0.0, 0.0, 0.0, k)
                s1, s2 = sensitivity_step(p, x, v, u, law.sample_time, s1, s2, j)
                x, v = step(p, x, v, u, law.sample_time)
                total += weights[0] * s1 * s1 + weights[1] * s2 * s2
            out[i, j] = total


def show_information(seed: int) -> None:
    """What the uncertainty of the set costs."""
    bench = bench_for("envelope")
    weights = thesis_weights(bench.noise, bench.limits)
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(20, bench.timing.horizon, 2)) * [bench.noise.angle, bench.noise.velocity]
    print("\nWeighted information under the shield, nominal brake, against a shield that knows it (20 noise draws)")
    for label, switch in (("+6 A throughout", bench.timing.horizon), ("+6 A, −6 A from 170 ms", 170)):
        means = {}
        for name in ("known", "envelope", "viscous"):
            out = np.zeros((len(noise), 4))
            compiled(flown)(
                make_law(bench_for(name)), bench.brake, switch, noise, (weights.angle, weights.velocity), out
            )
            means[name] = out.mean(axis=0)
        for name in ("envelope", "viscous"):
            ratios = ", ".join(
                f"{p} {r:.3f}" for p, r in zip(PARAMETER_NAMES, means[name] / means["known"], strict=True)
            )
            print(f"  {label:24s} {name:10s} ratio of F: {ratios}; F(f_v) = {means[name][3]:.3e}")


def show_speed(n: int, seed: int) -> None:
    """Cruise speeds, and what a call costs."""
    print("\nMean speed while crossing 20..60 rad under the envelope law, median and 90 % of the episodes [rad/s]")
    for truth in ("known", "envelope"):
        rows = search(bench_for("envelope"), n, seed, truth=truth, drops=("none",)).rows
        out, home = rows[rows[:, CRUISE_OUT] > 0, CRUISE_OUT], rows[rows[:, CRUISE_HOME] > 0, CRUISE_HOME]
        quantiles = [*np.quantile(out, [0.5, 0.9]), *np.quantile(home, [0.5, 0.9])]
        print("  true brake {:9s} out {:.0f}, {:.0f}; home {:.0f}, {:.0f}".format(truth, *quantiles))
    law = make_law(bench_for("envelope"))
    cases = {"outward": (50.0, 300.0, 100), "homeward": (40.0, -450.0, 400), "landing": (0.3, -70.0, 480)}
    print("Plain Python, one call [µs]: " + ", ".join(f"{name} {cost(law, *case):.1f}" for name, case in cases.items()))


def cost(law: ShieldLaw, angle: float, velocity: float, k: int) -> float:
    """Fastest of several timings of one call [µs]."""
    timer = timeit.Timer(lambda: shield(law, angle, velocity, 6.0, 0.0, 0.0, 0.0, k))
    return min(timer.repeat(repeat=9, number=2000)) / 2000 * 1e6


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100_000, help="of the main search; the others have a fifth")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    n, seed = arguments.episodes, arguments.seed
    show_search(n, seed)
    show_broken(n // 5, seed)
    show_induction(20 * n, seed)
    show_information(seed)
    show_speed(n // 20, seed)


if __name__ == "__main__":
    main()
