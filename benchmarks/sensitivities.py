"""Sensitivities by Euler and by the exact brake, held against finite differences, and the information they promise.

    python benchmarks/sensitivities.py

Those of the Euler brake are what automatic differentiation gives, sign() and all; the finite differences are central
ones of the exact flow. Errors are the largest over the run, relative to the largest sensitivity of the run; the larger
one of angle and velocity. Nominal brake, from rest at the origin, 500 samples of 1 ms, no limits. The script stops if
the exact sensitivities are off by more than 1e-4.
"""

from __future__ import annotations

import numpy as np

from emb_bench.information.fisher import fisher
from emb_bench.information.symmetric import Floats
from emb_bench.sim.open_loop import simulate
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, load_bench

UNKNOWN = (*PARAMETER_NAMES, "J")
STEP = 1e-6
ALLOWED = 1e-4


def excitations(count: int, t_s: float) -> dict[str, Floats]:
    """Currents by name [A]."""
    k = np.arange(count)
    t = k * t_s
    bits = np.random.default_rng(1).integers(0, 2, count // 10 + 1)
    return {
        "square 20 ms, 6 A": np.where(k // 10 % 2 == 0, 6.0, -6.0),
        "square 100 ms, 1.5 A": np.where(k // 50 % 2 == 0, 1.5, -1.5),
        "constant 0.9 A": np.full(count, 0.9),
        "chirp 1-50 Hz, 3 A": 3.0 * np.sin(2.0 * np.pi * (t + 0.5 * 49.0 / (count * t_s) * t**2)),
        "6 A for 80 ms, then back": np.where(k < 80, 6.0, np.where(k < 200, -3.0, 0.0)),
        "binary noise 10 ms, 4 A": np.where(bits[k // 10] == 1, 4.0, -4.0),
    }


def differences(bench: Bench, currents: Floats, name: str) -> Floats:
    """Central finite differences of the exact flow, shape (n, 2)."""
    exact, t_s = bench.plant("exact").mechanics, bench.timing.sample_time
    above, below = (
        simulate(exact, bench.brake._replace(**{name: getattr(bench.brake, name) * (1.0 + by)}), currents, t_s).states
        for by in (STEP, -STEP)
    )
    slope: Floats = (above - below)[1:] / (2.0 * STEP)
    return slope


def errors(bench: Bench, plant: str, currents: Floats, expected: dict[str, Floats]) -> dict[str, float]:
    """Largest relative error of the plant's sensitivities, by unknown."""
    run = simulate(bench.plant(plant).mechanics, bench.brake, currents, bench.timing.sample_time, UNKNOWN)
    return {
        name: float((np.abs(run.sensitivities[:, i] - expected[name]) / np.abs(expected[name]).max(axis=0)).max())
        for i, name in enumerate(UNKNOWN)
    }


def number(value: float, unit: str = "") -> str:
    """A table cell."""
    return f"{value:.3g}{unit}" if np.isfinite(value) else "not told"


def main() -> None:
    """Print the tables."""
    bench = load_bench()
    signals = excitations(bench.timing.horizon, bench.timing.sample_time)
    print("Largest error of the sensitivities against finite differences of the exact flow")
    print(f"{'excitation':26}{'brake':>7}" + "".join(f"{name:>11}" for name in UNKNOWN))
    for label, currents in signals.items():
        expected = {name: differences(bench, currents, name) for name in UNKNOWN}
        for plant in ("euler", "exact"):
            found = errors(bench, plant, currents, expected)
            cells = (f"{100.0 * e:.3g} %" if plant == "euler" else f"{e:.1e}" for e in found.values())
            print(f"{label if plant == 'euler' else '':26}{plant:>7}" + "".join(f"{cell:>11}" for cell in cells))
            if plant == "exact" and max(found.values()) > ALLOWED:
                raise SystemExit(f"{label}: the exact sensitivities are off by {max(found.values()):.1e}")

    print("\nPhysical Fisher information of k_m, k_1, T_c, f_v, and the Cramer-Rao bounds")
    print(
        f"{'excitation':26}{'brake':>7}{'log det':>10}{'lambda_min':>12}" + "".join(f"{n:>12}" for n in PARAMETER_NAMES)
    )
    for label, currents in signals.items():
        for name in ("euler", "exact"):
            found_fim = fisher(
                bench, bench.brake, currents, kind="physical", normalise_by="true", plant=bench.plant(name)
            )
            c = found_fim.criteria()
            bounds = "".join(f"{number(100.0 * b, ' %'):>12}" for b in found_fim.cramer_rao().values())
            log_det = "singular" if c.singular else f"{c.log_det:.2f}"
            print(f"{label if name == 'euler' else '':26}{name:>7}{log_det:>10}{c.lambda_min:12.3g}{bounds}")
            if c.singular:
                print(f"{'':33}  {found_fim.verdict().directions[0].text()}")


if __name__ == "__main__":
    main()
