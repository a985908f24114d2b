"""The look of every figure, and its bytes: same data, same picture, whatever matplotlib is set to."""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import matplotlib.style
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

DPI = 110
MAX_BYTES = 200 * 1024
"""Larger pictures are stored with a palette."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#882255", "#444444")
"""Okabe and Ito's palette without its yellow, lost on white; told apart by colour-blind readers too."""
DASHES: tuple[Any, ...] = (
    "-",
    (0, (5, 1.5)),
    (0, (6, 1.5, 1.5, 1.5)),
    (0, (1.5, 1.2)),
    (0, (3, 1, 1, 1, 1, 1)),
)

CHARACTERS_PER_INCH = 14.0
"""Of the legend's type."""
MANEUVER, BAND = "#EFE9DC", "#D9DEE3"
TRUTH_FILL, TRUTH_EDGE, PATH, POINT = "#D2D2D2", "#8C8C8C", "#707070", "#333333"

RC: dict[str, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "figure.titlesize": 10.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "axes.linewidth": 0.7,
    "axes.edgecolor": "#444444",
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "lines.dash_capstyle": "butt",
}


class LineStyle(NamedTuple):
    """How a filter is drawn in every panel."""

    color: str
    linestyle: Any


def line_style(index: int) -> LineStyle:
    """Style of the filter with this place in the experiment's order; forty differ."""
    shift = index // len(COLOURS)
    return LineStyle(COLOURS[index % len(COLOURS)], DASHES[(index + shift) % len(DASHES)])


def styles_of(labels: Sequence[str]) -> dict[str, LineStyle]:
    """Style of every filter, by label."""
    return {label: line_style(index) for index, label in enumerate(labels)}


@contextmanager
def fixed_look() -> Iterator[None]:
    """Our settings in place of the reader's, for building and for drawing."""
    with matplotlib.style.context(["default", RC]):
        yield


def plain(text: str) -> str:
    """Text that is shown as it stands: a dollar sign does not start a formula."""
    return text.replace("$", r"\$")


def with_unit(name: str, unit: str) -> str:
    """Quantity and, in parentheses, its unit if it has one."""
    return plain(f"{name} ({unit})" if unit else name)


def legend_below(figure: Figure, handles: Sequence[Artist], labels: Sequence[str]) -> None:
    """One legend below all panels, in as many columns as the figure is wide for."""
    if not labels:
        return
    entry = (max(len(label) for label in labels) + 8) / CHARACTERS_PER_INCH
    columns = max(int(figure.get_size_inches()[0] / entry), 1)
    rows = -(-len(labels) // columns)
    figure.legend(
        list(handles),
        [plain(label) for label in labels],
        loc="outside lower center",
        handlelength=2.6,
        ncols=-(-len(labels) // rows),
        columnspacing=1.6,
    )


def new_figure(width: float, height: float) -> Figure:
    """An empty figure (inches) that arranges its panels without overlap."""
    return Figure(figsize=(width, height), dpi=DPI, layout="constrained")


def png(figure: Figure) -> bytes:
    """The figure as PNG: without date or version, below 200 KiB for any figure of this package."""
    buffer = io.BytesIO()
    with fixed_look():
        FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None}, pil_kwargs={"optimize": True})
    if buffer.tell() > MAX_BYTES:
        image, buffer = Image.open(buffer).convert("RGB"), io.BytesIO()
        image.quantize(128, dither=Image.Dither.NONE).save(buffer, "png", optimize=True, dpi=(DPI, DPI))
    return buffer.getvalue()
