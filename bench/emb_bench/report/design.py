"""A design as text for a person."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from emb_bench.brake.parameters import UNITS
from emb_bench.numbers import relative
from emb_bench.report.text import Table, facts
from emb_runtime.estimator.estimate import NORMAL_95

if TYPE_CHECKING:  # a search for designs takes a second to import
    from emb_bench.design.report import Check, Report


def design_text(report: Report, written: str = "", *, verbose: bool = False) -> str:
    """Value of the criterion, and limits and smallest repeatabilities on the brake of the design."""
    d, nominal = report.metadata(), report.checks[0]
    alone = "" if report.problem.weights.velocity else " of the angle alone"
    brake = f"{d['model']}, {d['kind']} information{alone}, {'returns home' if d['returns'] else 'ends anywhere'}"
    optima = ", ".join(f"{value:.6g}" for value in d["local_optima"][: None if verbose else 4])
    bounds = ", ".join(f"{name} {_half(bound, name)}" for name, bound in (d["cramer_rao"] or {}).items())
    lines = facts(
        (d["value_is"], f"{d['value']:.7g}; {_verdict(nominal)}"),
        ("criterion", f"{d['criterion']} of {', '.join(d['params'])}"),
        ("brake", brake),
        ("repeatability", bounds and f"smallest possible, ± 95 % (k=2): {bounds}"),
        ("optima", f"{optima} ({d['starts']} starts, seed {d['seed']}{', interrupted' if d['interrupted'] else ''})"),
        ("currents", written or "not written: use -o design.csv"),
    )
    return "\n".join([*lines, *(["", *_checks(report).lines()] if verbose else [])])


def _half(deviation: float, name: str) -> str:
    """The smallest possible repeatability: in percent, or in the unit of an unknown that has no scale."""
    unit = UNITS.get(name, "").removesuffix("1") if math.isfinite(deviation) else ""  # none of a share
    return f"{relative(NORMAL_95 * deviation, name not in UNITS)} {unit}".rstrip()


def _verdict(check: Check) -> str:
    return f"{'limits kept' if check.limits_held else 'LIMITS LEFT'}, {'home' if check.home else 'not home'}"


def _checks(report: Report) -> Table:
    """Simulations of the design, on the brake that it was made for first."""
    rows = [
        [
            *(c.plant, f"{c.log_det:.4f}", f"{c.lowest_angle:.3f} to {c.highest_angle:.3f}", f"{c.largest_speed:.2f}"),
            *(f"{c.end_angle:.3f}", f"{c.end_velocity:.3f}", _verdict(c)),
        ]
        for c in report.checks
    ]
    header = ["simulated on", "log det", "angle [rad]", "rad/s", "end [rad]", "[rad/s]", ""]
    return Table("", header, rows, words=(0, 6))
