"""SVG map of an uncertainty for a page; larger values have a stronger colour.

Levels differ by equal factors, because the corners of an image can be a hundred times as uncertain as its
middle. Each level is one path of rectangles, so a map takes only some kilobytes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array

_LEVELS = 8
_CELLS = 120  # approximate number across
_MOST_DOTS = 1500
_FAINTEST, _STRONGEST = 0.06, 0.92  # opacity


def heat_map(values: Array, size: tuple[float, float], dots: Array, unit: str, label: str) -> str:
    """Draw values given on a grid that reaches from edge to edge, with interpolation.

    Parameters
    ----------
    values : (R, C) array
        Positive; nan if unknown. R and C are at least 2.
    size : (width, height)
        Of the area, in the unit of the dots.
    dots : (N, 2) array
        Places to mark.
    unit : str
        Of the values, for the scale below the map.
    label : str
        Description for screen readers.

    Returns
    -------
    svg : str
        Empty if no value is finite.
    """
    logarithms = np.log(np.where(values > 0, values, np.nan))
    seen = logarithms[np.isfinite(logarithms)]
    if not seen.size:
        return ""
    cells = _between(logarithms, -(-_CELLS // (values.shape[1] - 1)))
    low, high = float(seen.min()), max(float(seen.max()), float(seen.min()) + 0.01)
    bounds = np.linspace(low, high, _LEVELS + 1)
    level = np.clip(np.digitize(cells, bounds) - 1, 0, _LEVELS - 1)
    level[~np.isfinite(cells)] = -1
    width, height = size
    rows, columns = cells.shape
    texts = [f"{bound:.2g}" for bound in np.exp(bounds)]
    paths = "".join(
        f'<path d="{_rectangles(level == k)}" fill-opacity="{_opacity(k)}">'
        f"<title>{texts[k]} to {texts[k + 1]} {unit}</title></path>"
        for k in range(_LEVELS)
    )
    step = -(-len(dots) // _MOST_DOTS) or 1
    marks = "".join(f"M{x:.4g} {y:.4g}h0" for x, y in dots[::step])
    margin, edge = width / 10, width / 200
    return (
        f'<svg viewBox="{-edge:.3g} {-edge:.3g} {width + 2 * edge:.6g} {height + margin + edge:.6g}" '
        f'role="img" aria-label="{label}">'
        f'<rect width="{width:.6g}" height="{height:.6g}" class="frame"/>'
        f'<g class="heat" transform="scale({width / columns:.6g} {height / rows:.6g})">{paths}</g>'
        f'<path d="{marks}" class="marks" stroke-width="{width / 220:.3g}"/>'
        f"{_scale(texts, unit, width, height, margin)}</svg>"
    )


def _between(values: Array, times: int) -> Array:
    """Interpolate values linearly at the centres of the cells of a finer grid."""
    rows, columns = ((np.arange((count - 1) * times) + 0.5) / times for count in values.shape)
    r, c = rows.astype(int), columns.astype(int)
    down, across = (rows - r)[:, None], columns - c
    upper = values[r][:, c] * (1 - across) + values[r][:, c + 1] * across
    lower = values[r + 1][:, c] * (1 - across) + values[r + 1][:, c + 1] * across
    return np.asarray(upper * (1 - down) + lower * down)


def _rectangles(mask: NDArray[np.bool_]) -> str:
    """Path of the cells of a mask; adjacent cells of a row form one rectangle."""
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(int), axis=1)
    starts, ends = np.argwhere(edges == 1), np.argwhere(edges == -1)
    lengths = ends[:, 1] - starts[:, 1]
    return "".join(
        f"M{column} {row}h{length}v1h-{length}z"
        for (row, column), length in zip(starts.tolist(), lengths.tolist(), strict=True)
    )


def _opacity(level: int) -> str:
    return f"{_FAINTEST + (_STRONGEST - _FAINTEST) * level / (_LEVELS - 1):.2f}"


def _scale(texts: list[str], unit: str, width: float, height: float, margin: float) -> str:
    """Draw the scale of levels below the map, with their bounds."""
    each, font = width / (_LEVELS + 1.5), 0.28 * margin
    parts = ""
    for k, text in enumerate(texts):
        x = k * each
        if k < _LEVELS:
            parts += (
                f'<rect x="{x:.6g}" y="{height + 0.2 * margin:.6g}" width="{each:.6g}" '
                f'height="{0.3 * margin:.3g}" class="heat" fill-opacity="{_opacity(k)}"/>'
            )
        else:
            text = f"{text} {unit}"
        parts += f'<text x="{x:.6g}" y="{height + 0.9 * margin:.6g}" font-size="{font:.3g}">{text}</text>'
    return parts
