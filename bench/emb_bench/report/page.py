"""The page of a report."""

from __future__ import annotations

from emb_bench.analysis.terms import TERMS
from emb_bench.report.content import Content
from emb_bench.report.findings import advice, certainties, contributions, drift, model_check, parameters
from emb_bench.report.markup import Section, facts, page
from emb_bench.report.one_run import sections
from emb_bench.report.verdict import opening, verdict


def report_page(content: Content) -> str:
    """The whole report as HTML: the verdict first, then what it stands on.

    Raises:
        UsageError: matplotlib is missing.
    """
    study = content.study
    found: list[Section | None] = [verdict(content)]
    if study is not None:
        found += [parameters(study), model_check(study), advice(study), drift(study), contributions(content)]
        found.append(certainties(study))
    if len(content.runs) == 1:
        found += sections(content.runs[0], content, "")
    else:
        for number, run in enumerate(content.runs, 1):
            prefix = f"run-{number}-"
            within = sections(run, content, prefix)
            found.append(Section(f"Run {number}: {run.name}", within=within, name=f"run-{number}"))
    found.append(Section("What the words mean", facts(TERMS.items()), name="words"))
    names = ", ".join(run.name for run in content.reported)
    closing = (
        f"Made by {content.made_by} from {names}. The same content as numbers is in the JSON file beside this page."
    )
    kept = [section for section in found if section is not None]
    return page(f"Report of {names}", opening(content), kept, closing)
