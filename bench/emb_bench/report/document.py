"""JSON document beside the page."""

from __future__ import annotations

from typing import Any

from emb_bench.analysis.study import Study
from emb_bench.documents import to_json
from emb_bench.information.criteria import criteria
from emb_bench.logs import timing
from emb_bench.logs.info import info_document
from emb_bench.report import estimate as estimate_report
from emb_bench.report.content import Content, Run


def document(content: Content) -> dict[str, Any]:
    """JSON document with the content of the page; numbers may be infinite."""
    study = content.study
    found: dict[str, Any] = to_json(
        {
            "made_by": content.made_by,
            "acceptance": None if content.acceptance is None else content.acceptance.document(),
            "model_fits": None if study is None else study.model_fits,
            "predicts": None if study is None else study.predicts,
            "why_no_estimate": content.why_not,
            "left_out": [{"log": entry.path, "why": entry.words} for entry in content.left_out],
            "estimate": None if study is None else estimate_report.document(study),
            "runs": [_run_document(run, study) for run in content.runs],
        }
    )
    return found


def _run_document(run: Run, study: Study | None) -> dict[str, Any]:
    found: dict[str, Any] = {
        "began": run.began,
        "simulated": run.simulated,
        "why_not_estimated": run.why_not,
        "sha256": run.log_sha256,
        "info": info_document(run.log),
        "timing": None if run.timing is None else timing.document(run.timing),
    }
    x, alone = run.experiment, run.alone
    if x is not None:
        named = ("planned", "command_delay", "missing", "notes")
        found["experiment"] = {name: getattr(x, name) for name in named} | {
            "periods": len(x.currents),
            "measured": x.measured.sum(),
            "braked_periods": x.braked,
            "applied_current": x.currents,
            "angle": x.all_samples[:, 0],
            "velocity": x.all_samples[:, 1],
        }
    if alone is not None:
        found["alone"] = {"model_fits": alone.model_fits, "conclusions": alone.conclusions}
    if run.residuals is not None:
        found["residuals"] = {"angle": run.residuals[:, 0], "velocity": run.residuals[:, 1]}
    if run.growth is not None and study is not None:
        final = criteria(run.growth.samples, run.growth.labels, run.growth.params)
        found["information"] = {
            **run.growth.document(),
            "of_samples": {"log_det": final.log_det, "lambda_min": final.lambda_min},
        }
    return found
