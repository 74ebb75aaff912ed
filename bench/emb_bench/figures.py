"""Style of figures, and their way into a file or a page without a display. matplotlib is imported here only."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from emb_bench.output import replacing
from emb_runtime.errors import needs

PICTURES = (".png", ".svg", ".pdf")  # Endings of a picture
# Blue, orange, green, pink, sky, yellow of Okabe and Ito: distinguishable by colour-blind eyes too.
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
DASHED: Any = {"color": GREY, "linewidth": 0.9, "linestyle": (0, (5, 3)), "zorder": 0}  # Line of a limit
# Text stays text, the same figure is the same bytes, and the page shows through.
_SVG: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "emb-excite",
    "figure.facecolor": "none",
    "axes.facecolor": "none",
}


@contextmanager
def drawn(
    path: Path, rows: int, columns: int, title: str, size: tuple[float, float], *, dpi: int = 140, **shared: Any
) -> Iterator[Any]:
    """Axes to draw on, shape [rows, columns], size in inch; written to ``path`` at the end, whose ending is the format.

    ``shared`` are ``sharex`` and ``sharey`` of matplotlib's ``Figure.subplots``.
    """
    with _figure(rows, columns, size, {}, shared) as (figure, axes):
        figure.suptitle(title, fontsize=11.0, x=0.01, horizontalalignment="left")
        yield axes
        figure.align_ylabels(axes[:, 0])
        with replacing(path) as beside:
            figure.savefig(beside, dpi=dpi)


def svg(draw: Callable[[Any], None], rows: int, columns: int, size: tuple[float, float], **shared: Any) -> bytes:
    """A figure for a page, without a title, of a size in inch; ``draw`` gets the axes, shape [rows, columns].

    ``shared`` are ``sharex``, ``sharey`` and ``height_ratios`` of matplotlib's ``Figure.subplots``.
    """
    with _figure(rows, columns, size, _SVG, shared) as (figure, axes):
        from matplotlib.backends.backend_svg import FigureCanvasSVG

        draw(axes)
        figure.align_ylabels(axes[:, 0])
        file = io.BytesIO()
        # Figure.savefig would draw everything once more, for the layout alone.
        canvas: Any = FigureCanvasSVG(figure)
        canvas.print_svg(file, metadata={"Date": None, "Creator": None})
    return file.getvalue()


def for_notebook(rows: int, size: tuple[float, float], **shared: Any) -> tuple[Any, Any]:
    """A figure of matplotlib that a notebook shows, and its axes below each other; in matplotlib's own style."""
    with needs("a plot", "bench"):
        from matplotlib import pyplot as plt
    return plt.subplots(rows, figsize=size, layout="constrained", **shared)


@contextmanager
def _figure(rows: int, columns: int, size: tuple[float, float], style: Any, shared: Any) -> Iterator[tuple[Any, Any]]:
    with needs("a figure", "bench"):
        import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE | style):
        figure = Figure(figsize=size, layout="constrained")
        yield figure, figure.subplots(rows, columns, squeeze=False, **shared)
