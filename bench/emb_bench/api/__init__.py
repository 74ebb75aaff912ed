"""The commands from Python: simulation, logs, information, estimate, report, campaign, design.

Each function is the command of that name: :func:`simulate` is ``emb-run --iface sim``, :func:`fisher_information` is
``emb-replay fim``, :func:`design` is ``emb-design``, :func:`export_policy` is ``emb-export``, the others are
``emb-replay``'s. Options are a record, such as :class:`EstimateOptions`, or its fields as keywords. A run is an opened
log, or the path of one; with a map also a table in memory. Parameters are given as a sequence of names, or as one name.
All values are in SI units.

    from emb_bench import api

    run = api.simulate("run.mcap", parameters={"f_v": 3e-5})
    print(api.estimate(run, params="f_v"))
"""

from __future__ import annotations

from typing import NoReturn

from emb_bench.analysis.options import EstimateOptions, ExportOptions, ReportOptions
from emb_bench.api.campaigns import campaign
from emb_bench.api.designs import DesignOptions, design
from emb_bench.api.estimates import estimate, report
from emb_bench.api.information import FimOptions, fisher_information, interval, sensitivities
from emb_bench.api.policies import export_policy
from emb_bench.api.runs import Run, draw, export, info, open_run, rerun, timing, topic, topics
from emb_bench.api.simulation import simulate
from emb_bench.batch.row import CampaignOptions
from emb_runtime.errors import near

__all__ = [
    "CampaignOptions", "DesignOptions", "EstimateOptions", "ExportOptions", "FimOptions", "ReportOptions", "Run",
    "campaign", "design", "draw", "estimate", "export", "export_policy", "fisher_information", "info", "interval",
    "open_run", "report", "rerun", "sensitivities", "simulate", "timing", "topic", "topics",
]  # fmt: skip
_MEANT = {"load": "open_run", "read": "open_run", "fim": "fisher_information", "fit": "estimate", "plot": "draw"}
"""Names of other libraries for what is here."""


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> NoReturn:
    meant = f"; did you mean {_MEANT[name]}?" if name in _MEANT else near(name, __all__)
    raise AttributeError(f"module 'emb_bench.api' has no attribute {name!r}{meant}")
