"""The figure of all pictures, and the style of their panels. matplotlib is imported only to draw one."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import TYPE_CHECKING, Any

from neurocal_cli.errors import NeurocalError, one_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

INK, ACCENT = "#1f4e79", "#c0392b"
_TITLE = 32  # characters, for which a panel of a page has room


def check_available() -> None:
    """Raise a NeurocalError if matplotlib is not installed."""
    try:
        import matplotlib  # noqa: F401 - only tests whether it is installed
    except ImportError as error:
        raise NeurocalError(
            "pictures need matplotlib, which is not installed; pip install matplotlib"
        ) from error


@contextmanager
def drawing(size: tuple[float, float], pad: float, kind: str) -> Iterator[tuple[Figure, BytesIO]]:
    """A figure with a size and padding of panels [inches], and its file, which is written at the end."""
    check_available()
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Without pyplot there is no global state, no window and no choice of a backend.
    with rc_context({"font.size": 9, "axes.titlesize": 10, "svg.hashsalt": "neurocal"}):
        figure = Figure(figsize=size)
        figure.set_layout_engine("constrained", w_pad=pad, h_pad=pad)
        FigureCanvasAgg(figure)
        file = BytesIO()
        yield figure, file
        # Without a date, the same plot gives the same file.
        undated = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
        figure.savefig(file, format=kind, dpi=120, metadata=undated[kind])


def panels_in_rows(figure: Figure, count: int, columns: int) -> list[Axes]:
    """So many panels in rows; places that are left are empty."""
    panels = figure.subplots(-(-count // columns), columns, squeeze=False).ravel()
    for unused in panels[count:]:
        unused.set_axis_off()
    return list(panels[:count])


def plain(text: str) -> str:
    """Escape text so that matplotlib does not read it as mathematics."""
    return one_line(text).replace("$", r"\$")


def entitle(axes: Axes, title: str) -> None:
    """Set the title of a panel, in lines that the panels of a page have room for."""
    axes.set_title("\n".join(textwrap.fill(line, _TITLE) for line in title.split("\n")), loc="left")


def style(axes: Axes, title: str) -> None:
    """Set title, grid and frame of a panel."""
    entitle(axes, title)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def colour_bar(axes: Axes, drawn: ScalarMappable, label: str, **how: Any) -> None:
    """Add a scale as high as the panel, whose room is the panel's own: nothing else moves for it."""
    scale = axes.inset_axes((1.03, 0.0, 0.04, 1.0))
    axes.figure.colorbar(drawn, cax=scale, label=label, **how)


def say(axes: Axes, text: str) -> None:
    """Show a text instead of a panel that cannot be drawn."""
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes, wrap=True)
    axes.set_axis_off()
