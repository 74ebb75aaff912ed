"""The commands from Python: simulation, logs, information, estimate, report, campaign, design.

Each function is the command of that name, and its arguments are the command's options: :func:`simulate` is ``emb-run
--iface sim``, :func:`fisher_information` is ``emb-replay fim``, :func:`design` is ``emb-design``, the others are
``emb-replay``'s. A run is an opened log, or the path of one. Parameters are given as a sequence of names, or as one
name. All values are in SI units.

    from emb_bench import api

    run = api.simulate("run.mcap", parameters={"f_v": 3e-5})
    print(api.estimate(run, params="f_v"))
"""

from __future__ import annotations

from emb_bench.api.campaigns import campaign
from emb_bench.api.designs import design
from emb_bench.api.estimates import estimate, report
from emb_bench.api.information import fisher_information
from emb_bench.api.runs import Run, draw, export, info, open_run, rerun, timing, topic
from emb_bench.api.simulation import simulate

__all__ = [
    "Run",
    "campaign",
    "design",
    "draw",
    "estimate",
    "export",
    "fisher_information",
    "info",
    "open_run",
    "report",
    "rerun",
    "simulate",
    "timing",
    "topic",
]


def __dir__() -> list[str]:
    return __all__
