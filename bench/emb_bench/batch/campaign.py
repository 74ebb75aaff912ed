"""A campaign: many logs, each evaluated by itself, a file of rows, and a summary.

Logs are distributed to processes or to Ray: a process that dies, or takes too long, costs its log only.
"""

from __future__ import annotations

import os
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path, PurePath

from emb_bench.batch.chart import draw_chart
from emb_bench.batch.evaluate import evaluate_one
from emb_bench.batch.row import ENDINGS as ROWS
from emb_bench.batch.row import CampaignOptions, Row, Source, failed, write_rows
from emb_bench.batch.summary import Campaign, mark_copies, summarise
from emb_bench.config.bench import load_bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.figures import PICTURES
from emb_bench.output import progress, replacing, require_place
from emb_bench.parallel import Lost, processors, shared_out, shared_out_on_ray
from emb_runtime.errors import UsageError, needs
from emb_runtime.records import HOMING_LOG, LISTEN_ONLY_LOG
from emb_runtime.system.input_file import near_file
from emb_runtime.system.terminal import mention

SUFFIX = ".mcap"
PASSED_OVER = (HOMING_LOG + SUFFIX, LISTEN_ONLY_LOG + SUFFIX)  # Logs of emb-run that hold no experiment


def run_campaign(paths: Sequence[Path], output: Path, options: CampaignOptions) -> Campaign:
    """Evaluate logs, and write their rows; the arguments are those of :func:`emb_bench.api.campaign`."""
    bench = None if options.bench is None else load_bench(options.bench, analysis=True)
    if bench is not None:
        bench.plant(options.model or DEFAULT_PLANT)
        options.question(bench)
    require_place("--output", output, ROWS)
    chart = None if options.chart is None else Path(options.chart)
    require_place("--chart", chart, PICTURES)
    with needs("a campaign", "bench"):
        import numba  # noqa: F401
        import pyarrow  # noqa: F401
        import scipy  # noqa: F401
    sources, evaluate = find(paths), partial(evaluate_one, options=options, bench=bench)
    limit = options.time_limit
    with replacing(output) as beside:
        if options.ray is None:
            numbered = shared_out(evaluate, sources, options.jobs or processors(), limit)
        else:
            numbered = shared_out_on_ray(evaluate, sources, options.jobs, limit, options.ray)
        rows = mark_copies(in_order(sources, numbered))
        write_rows(beside, output.suffix.lower(), rows, options, bench)
    found = summarise(rows, options, str(output), bench)
    if chart is not None and not draw_chart(rows, found, chart):
        mention(f"{chart}: not drawn: no run that the model fits identifies a parameter")
    return found


def in_order(sources: Sequence[Source], numbered: Generator[tuple[int, Row | Lost], None, None]) -> list[Row]:
    """All rows in the order of the logs; shows the progress, and names each failure at once."""
    rows = dict[int, Row]()
    with closing(numbered), progress("logs", len(sources)) as advance:  # processes end with the generator
        for number, found in numbered:
            source = sources[number]
            row = failed(source, f"{source.path}: {found.why}") if isinstance(found, Lost) else found
            rows[number] = row
            advance("")
            if row["error"] is not None:
                mention(f"FAILED {row['error']}")
    return [rows[number] for number in range(len(sources))]


def find(paths: Sequence[Path]) -> list[Source]:
    """The logs in files and folders, sorted; one that is reached twice is taken once.

    A file is a log whatever its name; a folder is searched for ``*.mcap``, with the folders in it, and ways home and
    mere listening are passed over. A folder that cannot be listed, and what is called ``*.mcap`` and is no file, are in
    the list with their trouble.
    """
    found: list[Source] = []
    for path in sorted(set(paths), key=str):
        if path.is_dir():
            found += _inside(path)
        elif os.path.lexists(path):
            found.append(_source(path.parent, path, ""))
        else:
            raise UsageError(f"{path}: expected a log or a folder with logs, and there is none{near_file(path)}")
    seen: set[str] = set()
    logs = []
    for source in sorted(found, key=lambda s: (s.root, s.log)):
        real = os.path.realpath(source.path)
        if real not in seen:
            logs.append(source)
        seen.add(real)
    if not logs:
        raise UsageError(f"no *{SUFFIX} in {', '.join(map(str, paths))}")
    return logs


def _inside(root: Path) -> Iterator[Source]:
    """Follow links to folders as well, each folder once, so that a loop of them ends."""
    visited: set[str] = set()
    unlisted: list[OSError] = []
    for folder, folders, files in os.walk(root, onerror=unlisted.append, followlinks=True):
        real = os.path.realpath(folder)
        if real in visited:
            folders.clear()
            continue
        visited.add(real)
        folders.sort()
        for name in files:
            if name.lower().endswith(SUFFIX) and not name.lower().endswith(PASSED_OVER):
                yield _source(root, Path(folder, name), "")
    for err in unlisted:
        yield _source(root, Path(err.filename), f"the folder cannot be listed: {err.strerror}")


def _source(root: Path, path: Path, trouble: str) -> Source:
    relative = PurePath(os.path.relpath(path, root))
    if not trouble and path.exists() and not path.is_file():
        trouble = "expected a file, and it is none"  # opening a pipe would wait for ever
    return Source(str(path), str(root), relative.as_posix(), relative.parent.as_posix(), trouble)
