"""A design as text."""

from __future__ import annotations

from emb_bench.design.report import Report
from emb_bench.report.render import text as rendered
from emb_bench.report.table import Table


def text(report: Report) -> str:
    """The design for a person."""
    rows = [
        [
            *(c.plant, f"{c.log_det:.4f}", f"{c.lambda_min:.5g}", f"{c.trace_inverse:.5g}"),
            *(f"{c.lowest_angle:.4f} to {c.highest_angle:.4f}", f"{c.largest_speed:.4f}"),
            *(f"{c.end_angle:.3f}", f"{c.end_velocity:.3f}"),
            *("limits held" if c.limits_held else "LIMITS LEFT", "home" if c.home else "not home"),
        ]
        for c in report.checks
    ]
    header = ["simulated again", "log det", "lambda_min", "tr M^-1", "angle [rad]", "speed", "end [rad]", "[rad/s]"]
    checks = Table("", [*header, "", ""], rows, words=(0, 8, 9))
    return rendered("design.txt.j2", d=report.metadata(), checks=checks)
