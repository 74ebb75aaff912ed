"""Guarantee and cost of the envelope shield: the figures of docs/explanation/shield.md.

    python -m tests.searches.shield [--episodes 20000] [--seed 0]

Searches for violations with adversarial episodes on three brakes (forward Euler, a finer one with an exact standstill,
the bench's plants) and by hill climbing, breaks each assumption in turn to show that the search can fail, samples the
induction steps, measures what a freewheeling node would do, and what each envelope and extension costs in information.
"""

from __future__ import annotations

import argparse
import sys
import timeit
from dataclasses import replace
from typing import Any

import numpy as np

from emb_bench.brake.euler import sensitivity_step, step
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench, load_bench
from emb_bench.information.fisher import physical_weights
from emb_runtime.config.bench import BrakeParameters, Ranges
from emb_runtime.safety.end_stop import end_stop_speed
from emb_runtime.safety.shield import NO_PAST, shield
from emb_runtime.safety.shield_design import ShieldLaw, chatter_excess, damped_excess, make_law
from tests.properties.shield_climb import climb
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
    coasting_induction,
    draw_brakes,
    induction,
    lagging_induction,
    search,
)

KNOWN_COASTING: dict[str, Any] = {"envelope": "coasting", "angle_margin": 1.5}
COASTING: dict[str, Any] = {"envelope": "coasting", "angle_margin": 1.1}
ROUGH: dict[str, Any] = {"current_lag": 0.002, "break_away": 1.2, "f_l": 1e-6}
EXTENSIONS: dict[str, dict[str, Any]] = {
    "break_away 1.2, f_l 2e-6 m": {"break_away": 1.2, "f_l": 2e-6},
    "current_lag 0.5 ms": {"current_lag": 0.0005},
    "current_lag 2 ms": {"current_lag": 0.002},
    "current_lag 2 ms, break_away, f_l": ROUGH,
    "frame ages 0..1": {"frame_age": (0, 1)},
    "frame ages 0..3": {"frame_age": (0, 3)},
    "frame ages 3..3": {"frame_age": (3, 3)},
    "frame ages 0..5": {"frame_age": (0, 5)},
    "frame ages 5..5": {"frame_age": (5, 5)},
    "coasting": COASTING,
}
PLANTS: dict[str, dict[str, Any]] = {
    "stribeck": {"break_away": 1.2},
    "load": {"break_away": 1.2, "f_l": 2e-6},
    "lag": {"current_lag": 0.002},
    "rough": ROUGH,
    "cubic": {},
    "hysteresis": {},
}


def bench_for(ranges: str = "envelope", **declared: Any) -> Bench:
    """The shipped bench with another set and other bounds for its shield; ``known`` is the nominal brake alone."""
    bench = load_bench()
    known = Ranges("known", bench.brake, bench.brake)
    return replace(
        bench,
        ranges={**bench.ranges, "known": known},
        shield=bench.shield._replace(ranges=ranges, **declared),
    )


def report(label: str, found: Found) -> bool:
    """One line of a table of :func:`table`; whether a limit was passed, or a brake that lost no command is not home."""
    r, told = found.rows, found.obeyed
    away = int((~found.home[told]).sum())
    line = (
        f"{label:44s} {len(r):8d} {int(found.violated.sum()):9d}   {r[:, LOWEST].min():7.2f} {r[:, HIGHEST].max():7.2f}"
    )
    line += f"   {r[:, SLOWEST].min():7.1f} {r[:, FASTEST].max():6.1f}"
    if told.any():
        line += f"   {away:6d}/{int(told.sum()):<7d} {np.abs(r[told, END_ANGLE]).max():6.3f}"
        line += f" {np.abs(r[told, END_VELOCITY]).max():6.2f}"
    print(line, flush=True)
    return bool(found.violated.any()) or away > 0


def table(title: str) -> None:
    """Head of a table of searches."""
    print(f"\n{title}")
    print(
        f"{'':44s} {'episodes':>8s} {'violating':>9s}   {'angle [rad]':>15s}   {'velocity [rad/s]':>14s}   "
        f"{'not home':>14s} {'worst end':>13s}"
    )


def show_search(n: int, seed: int) -> bool:
    """The law under its own assumptions; whether it fails."""
    table("Search with the law's own assumptions (half of the episodes lose commands)")
    found = search(bench_for(), n, seed)
    fails = report("envelope", found)
    for name in ("pm50", "viscous", "viscous-stiffness", "known"):
        fails |= report(name, search(bench_for(name), n // 5, seed))
    for name, declared in EXTENSIONS.items():
        fails |= report(f"envelope, {name}", search(bench_for(**declared), n // 5, seed, freewheel="coasting" in name))
    table("Brakes that are not the model, half by the bench's own solver: without the bound and with it")
    for plant, declared in PLANTS.items():
        report(f"{plant}, nothing declared", search(bench_for(), n // 5, seed, plant=plant))
        if declared:
            fails |= report(f"{plant}, declared", search(bench_for(**declared), n // 5, seed, plant=plant))
    print("\nHome in spite of lost commands (envelope), share of episodes:")
    print("  " + ", ".join(f"{d} {found.home[found.of(d)].mean():.3f}" for d in DROPS))
    return fails


def show_climbs(n: int, seed: int) -> bool:
    """Hill climbing, 50 chains each; whether one passes a limit, or none does where the margin is left out."""
    print(
        "\nHill climbing, least margin of all chains (angle [rad], or speed [10 rad/s]); negative: a limit was passed"
    )
    chains, fails = 50, False
    for name, declared in {"envelope": {}, **EXTENSIONS}.items():
        margins = climb(bench_for(**declared), chains, n // chains, seed)
        print(f"  {name:36s} {chains * (n // chains):7d} episodes   {margins.min():7.3f}")
        fails |= bool(margins.min() < 0.0)
    law = make_law(bench_for())
    careless = law._replace(bottom=law.bottom - 0.3, top=law.top + 0.3)
    margins = climb(bench_for(), chains, n // chains, seed, law=careless)
    print(f"  {'without angle margin':36s} {chains * (n // chains):7d} episodes   {margins.min():7.3f}")
    return fails or bool(margins.min() >= 0.0)


def show_broken(n: int, seed: int) -> bool:
    """Each assumption broken in turn; whether a search does not find one."""
    bench = bench_for()
    law = make_law(bench)
    table("Search with an assumption broken (violations must be found)")
    careless = law._replace(bottom=law.bottom - 0.3, top=law.top + 0.3)
    finds = report("brake outside the set (viscous, envelope)", search(bench_for("viscous"), n, seed, truth="envelope"))
    finds &= report("no angle margin", search(bench, n, seed, law=careless))
    finds &= report("frames one period late", search(bench, n, seed, ages=(0, 1)))
    found = search(bench, n, seed, drops=("killed",), freewheel=True)
    finds &= report("freewheel after a kill", found)
    for stop, column, limit in (("lower", LOWEST, -10.0), ("upper", HIGHEST, 100.0)):
        hit = found.rows[:, column] < limit if limit < 0.0 else found.rows[:, column] > limit
        speed = found.rows[hit, LAST_SPEED].max() if hit.any() else 0.0
        print(f"  freewheel: {hit.mean():.1%} of the kills run into the {stop} stop, with up to {speed:.0f} rad/s")
    return not finds


def show_induction(n: int, seed: int) -> bool:
    """States of the safe set that one step takes out of it; whether there are any."""
    outside = 0
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
        outside += left
        print(f"  {name:20s} {left} of {tried}; margin used: damped stop {excess:.3f} rad, chatter {chatter:.3f} rad")
    for name, declared, kept, width in (
        ("current_lag 2 ms", {"current_lag": 0.002}, lagging_induction, 16),
        ("coasting", COASTING, coasting_induction, 10),
    ):
        bench = bench_for(**declared)
        rng = np.random.default_rng(seed)
        failed = np.zeros(min(n, 1_000_000), dtype=np.bool_)
        brakes = draw_brakes(rng, bench.range_set("envelope"), len(failed))
        tried = compiled(kept)(make_law(bench), brakes, rng.random((len(failed), width)), failed)
        outside += int(failed.sum())
        print(f"  {name:20s} {int(failed.sum())} of {tried}")
    return outside > 0


def flown(
    law: ShieldLaw, p: BrakeParameters, plans: Floats, noise: Floats, weights: tuple[float, float], out: Floats
) -> None:
    """Plans in shares of the limit, played into the shield on Euler's brake: the information on all four parameters.

    Args:
        law: the shield's.
        p: the brake.
        plans: shape [M, steps].
        noise: of the measurements, shape [D, steps, 2].
        weights: of the squared sensitivities.
        out: becomes the information, shape [M, D, 4, 4].
    """
    for m in range(plans.shape[0]):
        for i in range(noise.shape[0]):
            x = v = 0.0
            past = NO_PAST
            s = np.zeros((4, 2))
            for k in range(law.steps):
                wanted = law.current * plans[m, k]
                u, _ = shield(law, x + noise[i, k, 0], v + noise[i, k, 1], wanted, past, k)
                past = (u, past[0], past[1], past[2], past[3])
                for j in range(4):
                    s[j, 0], s[j, 1] = sensitivity_step(p, x, v, u, law.sample_time, s[j, 0], s[j, 1], j)
                x, v = step(p, x, v, u, law.sample_time)
                for a in range(4):
                    for b in range(4):
                        out[m, i, a, b] += weights[0] * s[a, 0] * s[b, 0] + weights[1] * s[a, 1] * s[b, 1]


def blind_plans(steps: int) -> Floats:
    """+6 A throughout, one switch at 170 ms, and square waves with and without early reversals, shape [M, steps]."""
    k = np.arange(steps)
    plans = [np.ones(steps), np.where(k < 170, 1.0, -1.0)]
    early = np.where((k >= 17) & (k < 29), -1.0, 1.0)
    for half in (20, 30, 40, 55, 70, 90, 110, 140, 170, 200, 215, 250, 500):
        square = np.where(k // half % 2 == 0, 1.0, -1.0)
        plans += [square, np.where(k < 29, early, np.where((k - 29) // half % 2 == 0, 1.0, -1.0))]
    return np.array(plans)


def show_information(seed: int) -> None:
    """Prints the cost of the uncertainty of the set, of each extension and of each envelope."""
    bench = bench_for()
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(8, bench.timing.horizon, 2)) * [bench.noise.angle, bench.noise.velocity]
    weights = physical_weights(bench.noise)
    plans = blind_plans(bench.timing.horizon)
    prior = 12.0 * np.eye(4)  # of a uniform ±50 %
    print(
        "\nPhysical information, nominal brake (Euler), relative parameters: +6 A throughout, and the best of "
        f"{len(plans)} blind plans"
    )
    print(f"  {'':36s} {'+6 A: log det':>14s} {'F(f_v)':>10s} {'best log det':>13s} {'best F(f_v)':>12s}")
    cases = [("the brake is known", bench_for("known")), ("known, coasting", bench_for("known", **KNOWN_COASTING))]
    cases += [("viscous", bench_for("viscous")), ("envelope", bench)]
    cases += [(f"envelope, {name}", bench_for(**declared)) for name, declared in EXTENSIONS.items()]
    for name, case in cases:
        out = np.zeros((len(plans), len(noise), 4, 4))
        compiled(flown)(make_law(case), bench.brake, plans, noise, (weights.angle, weights.velocity), out)
        log_det = np.linalg.slogdet(out + prior)[1].mean(axis=1)
        viscous = out[:, :, 3, 3].mean(axis=1)
        print(f"  {name:36s} {log_det[0]:14.2f} {viscous[0]:10.3e} {log_det.max():13.2f} {viscous.max():12.3e}")


def show_speed(n: int, seed: int) -> None:
    """Cruise speeds, and what a call costs."""
    freewheel = replace(bench_for(), node=replace(bench_for().node, stop="freewheel"))
    print(f"\nWorst end-stop speed of a node that lets go (end_stop_speed): {end_stop_speed(freewheel):.0f} rad/s")
    print("\nMean speed while crossing 20..60 rad under the envelope law, median and 90 % of the episodes [rad/s]")
    for truth in ("known", "envelope"):
        rows = search(bench_for(), n, seed, truth=truth, drops=("none",)).rows
        out, home = rows[rows[:, CRUISE_OUT] > 0, CRUISE_OUT], rows[rows[:, CRUISE_HOME] > 0, CRUISE_HOME]
        print(f"  true brake {truth:9s} out {cruise(out)}; home {cruise(home)}")
    law = make_law(bench_for())
    cases = {"outward": (50.0, 300.0, 100), "homeward": (40.0, -450.0, 400), "landing": (0.3, -70.0, 480)}
    print("Plain Python, one call [µs]: " + ", ".join(f"{name} {cost(law, *case):.1f}" for name, case in cases.items()))


def cruise(speeds: Floats) -> str:
    """Median and 90 % of speeds, in words where no episode crossed."""
    return "{:.0f}, {:.0f}".format(*np.quantile(speeds, [0.5, 0.9])) if len(speeds) else "no crossing"


def cost(law: ShieldLaw, angle: float, velocity: float, k: int) -> float:
    """Fastest of several timings of one call [µs]."""
    timer = timeit.Timer(lambda: shield(law, angle, velocity, 6.0, NO_PAST, k))
    return min(timer.repeat(repeat=9, number=2000)) / 2000 * 1e6


def main() -> int:
    """Print all figures; 1 if the shield fails, or a search that must find what is broken does not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20_000, help="of the main search; the others have a fifth")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    n, seed = arguments.episodes, arguments.seed
    fails = show_search(n, seed)
    fails |= show_climbs(n // 5, seed)
    fails |= show_broken(max(n // 5, 1), seed)
    fails |= show_induction(20 * n, seed)
    show_information(seed)
    show_speed(max(n // 20, 1), seed)
    return 1 if fails else 0


if __name__ == "__main__":
    sys.exit(main())
