"""How figures look and how they reach a file, without a display. matplotlib is imported here only."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from emb_runtime.errors import UsageError

# Blue, orange, green, pink, sky, yellow of Okabe and Ito: told apart by colour-blind eyes too.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
GREY = "#888888"
STYLE: Any = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e5e5e5",
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
}


@contextmanager
def drawn(path: Path, rows: int, columns: int, title: str, size: tuple[float, float], **shared: Any) -> Iterator[Any]:
    """Axes to draw on, shape [rows, columns]; written to ``path`` at the end, whose ending is the format.

    Args:
        path: the file.
        rows: of axes.
        columns: of axes.
        title: above them all.
        size: width and height [inch].
        shared: ``sharex`` and ``sharey`` of matplotlib's ``Figure.subplots``.

    Raises:
        UsageError: matplotlib is missing, or the file cannot be written.
    """
    try:
        import matplotlib as mpl
    except ImportError as err:
        raise UsageError("the figures need matplotlib: install emb-excite[bench]") from err
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title, fontsize=11.0, x=0.01, horizontalalignment="left")
        axes = figure.subplots(rows, columns, squeeze=False, **shared)
        yield axes
        figure.align_ylabels(axes[:, 0])
        try:
            figure.savefig(path, dpi=140)
        except OSError as err:
            raise UsageError(f"{path}: cannot write the figure: {err.strerror}") from err
