"""Many logs, each evaluated alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emb_bench.api.arguments import options_of
from emb_bench.batch.row import CampaignOptions
from emb_runtime.errors import needs

if TYPE_CHECKING:
    from emb_bench.batch.summary import Campaign


def campaign(
    paths: str | Path | Sequence[str | Path], output: str | Path, options: CampaignOptions | None = None, **more: Any
) -> Campaign:
    """Many logs in parallel: one row each in a Parquet or CSV file, and a summary.

    A row has the identity of the run, its Fisher information at the bench's nominal brake, and an estimate of the
    parameters. A log that cannot be evaluated becomes a row with the reason. The rows do not depend on the number of
    processes or machines. On a Ray cluster all machines need emb-excite and the logs at the same paths.

    Args:
        paths: logs, or folders to search for *.mcap.
        output: file to write, Parquet or CSV by its ending.
        options: a record of options.
        more: its fields as keywords: ``campaign("runs", "rows.csv", jobs=4)``.

    Returns:
        The summary; the rows are in the file.

    Raises:
        UsageError: an argument is wrong, there is no log, a library is missing, or a file cannot be written.
    """
    with needs("a campaign", "bench"):
        from emb_bench.batch.campaign import run_campaign
    places = [Path(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]
    return run_campaign(places, Path(output), options_of("campaign", CampaignOptions, options, more))
