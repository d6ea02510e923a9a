"""Drawings of a page as SVG: residuals and their scatter, errors by view, a map of an uncertainty, the board.

Colours come from the style of the page, so they suit its light and dark modes. The levels of a map differ
by equal factors, because the corners of an image can be a hundred times as uncertain as its middle. Each
level is one path of rectangles, so a map takes only some kilobytes.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array

_MOST = 4000  # greatest number of vectors in a drawing
_MOST_DOTS = 1500  # on a map
_LONGEST = 0.04  # length of a residual of three times the rms, as a share of the image's width
_CELLS = 120  # approximate number of cells of a map across
_LEVELS = 8
_FAINTEST, _STRONGEST = 0.06, 0.92  # opacity
_LARGEST = 0.45  # radius of the largest deviation of a board, as a share of the points' spacing


def residual_map(
    pixels: Array,
    residuals: Array,
    size: tuple[int, int],
    scale: float | None = None,
    bold: float = 1.0,
    *,
    left_out: Array | None = None,
    photograph: bytes | None = None,
) -> str:
    """Draw residuals (N, 2) [px] as enlarged lines from their pixels, also over a JPEG photograph.

    `scale` is the enlargement of the residuals; by default their `enlargement`. `bold` is a factor on the
    thickness of lines, for small drawings. Points `left_out` (M, 2) become crosses.
    """
    width, height = size
    scale = enlargement(residuals, size) if scale is None else scale
    step = -(-len(pixels) // _MOST)
    ends = pixels[::step] + scale * residuals[::step]
    path = "".join(
        f"M{u:.1f} {v:.1f}L{x:.1f} {y:.1f}" for (u, v), (x, y) in zip(pixels[::step], ends, strict=True)
    )
    dots = "".join(f"M{u:.1f} {v:.1f}h0" for u, v in pixels[::step])
    arm, crosses = width / 100, ""
    if left_out is not None and len(left_out):
        arms = "".join(
            f"M{u - arm:.1f} {v - arm:.1f}L{u + arm:.1f} {v + arm:.1f}"
            f"M{u - arm:.1f} {v + arm:.1f}L{u + arm:.1f} {v - arm:.1f}"
            for u, v in left_out
        )
        crosses = f'<path d="{arms}" class="out" stroke-width="{width / 300:.2f}"/>'
    image = "" if photograph is None else b64encode(photograph).decode()
    if image:  # its pixel centres are at whole numbers
        place = f'x="-.5" y="-.5" width="{width}" height="{height}"'
        image = f'<image {place} href="data:image/jpeg;base64,{image}"/>'
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="residuals, {scale:.3g} times enlarged">'
        f'<rect width="{width}" height="{height}" class="frame"/>{image}'
        f'<path d="{dots}" class="dots" stroke-width="{bold * width / 240:.2f}"/>'
        f'<path d="{path}" class="lines" stroke-width="{bold * width / 450:.2f}"/>'
        f"{crosses}</svg>"
    )


def enlargement(residuals: Array, size: tuple[int, int]) -> float:
    """Round factor that makes residuals (N, 2) [px] visible in an image of a size [px]."""
    rms = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))) if len(residuals) else 0.0
    if not rms > 0:
        return 1.0
    wanted = _LONGEST * size[0] / (3 * rms)
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(m for m in (1, 2, 5) if m * power <= wanted))


def scatter(residuals: Array) -> str:
    """Draw residuals (N, 2) [px] as points, with a circle of their rms, as in the pictures of ``--plot``."""
    sigma = float(np.sqrt(np.mean(residuals**2))) if len(residuals) else 0.0
    if not sigma > 0:
        return ""
    step = -(-len(residuals) // _MOST)
    shown = np.clip(residuals[::step] / sigma, -5.5, 5.5)
    dots = "".join(f"M{x:.2f} {y:.2f}h0" for x, y in shown)
    return (
        '<svg viewBox="-6 -6 12 12" role="img" aria-label="du and dv of all points">'
        '<rect x="-6" y="-6" width="12" height="12" class="frame"/>'
        f'<path d="{dots}" class="dots" stroke-width="0.11"/>'
        '<path d="M-6 0H6M0 -6V6" class="axis" stroke-width="0.02"/>'
        f'<circle r="{np.sqrt(2):.3f}" class="lines" stroke-width="0.07"/>'
        f'<text x="-5.8" y="-5.3" font-size="0.5">circle: rms {np.sqrt(2) * sigma:.2g} px</text>'
        '<text x="5.8" y="0.6" font-size="0.5" text-anchor="end">du</text>'
        '<text x="0.2" y="5.8" font-size="0.5">dv</text></svg>'
    )


def error_bars(names: Sequence[str], errors: Sequence[float], overall: float) -> str:
    """Draw the rms error of each view as a bar, with a line at that of all points, and axes."""
    count = len(names)
    if not count or not max(errors, default=0) > 0:
        return ""
    width, height, left = 640.0, 240.0, 60.0
    step = _round_step(max(*errors, overall) / 4)
    most = step * np.ceil(1.02 * max(*errors, overall) / step)
    each = (width - left) / count

    def level(value: float) -> float:
        return height * (1 - value / most)

    bars = "".join(
        f'<rect x="{left + (k + 0.1) * each:.1f}" y="{level(error):.1f}" width="{0.8 * each:.1f}" '
        f'height="{height - level(error):.1f}" class="bar">'
        f"<title>{escape(name)}: {error:.3g} px</title></rect>"
        for k, (name, error) in enumerate(zip(names, errors, strict=True))
    )
    ticks = [step * k for k in range(round(most / step) + 1)]
    numbers = "".join(
        f'<text x="{left - 8:.0f}" y="{level(tick) + 6:.1f}" font-size="17" '
        f'text-anchor="end">{tick:.3g}</text>'
        for tick in ticks
    )
    lines = "".join(f"M{left - 4:.0f} {level(tick):.1f}H{width:.0f}" for tick in ticks)
    numbered = "".join(
        f'<text x="{left + (k + 0.5) * each:.1f}" y="{height + 20:.0f}" font-size="17" '
        f'text-anchor="middle">{k + 1}</text>'
        for k in range(0, count, max(1, -(-count // 12)))
    )
    return (
        f'<svg viewBox="0 -12 {width:.0f} {height + 38:.0f}" role="img" aria-label="rms error of each view">'
        f'<path d="{lines}" class="axis" stroke-width="0.5"/>{bars}{numbers}{numbered}'
        f'<path d="M{left:.0f} {level(overall):.1f}H{width:.0f}" class="lines" stroke-width="2"/></svg>'
    )


def board_shape(across: Array, height: Array) -> str:
    """Draw heights (n,) of points of a plane (n, 2) as discs: the area is the height, the colour its sign."""
    low, high = across.min(axis=0), across.max(axis=0)
    size = np.maximum(high - low, 1e-9 * float((high - low).max()))
    spacing = float(np.sqrt(size.prod() / len(across)))
    largest = float(np.abs(height).max())
    if not largest > 0:
        return ""
    radii = _LARGEST * spacing * np.sqrt(np.abs(height) / largest)
    discs = "".join(
        f'<circle cx="{x:.4g}" cy="{y:.4g}" r="{r:.3g}" class="{"up" if h > 0 else "down"}">'
        f"<title>{h:+.2g}</title></circle>"
        for (x, y), r, h in zip(across - low, radii, height, strict=True)
    )
    x, y = -0.5 * spacing, -0.5 * spacing
    w, h = size + spacing
    return (
        f'<svg viewBox="{x:.4g} {y:.4g} {w:.4g} {h:.4g}" role="img" aria-label="shape of the board">'
        f'<rect x="{x:.4g}" y="{y:.4g}" width="{w:.4g}" height="{h:.4g}" class="frame"/>{discs}</svg>'
    )


def _round_step(least: float) -> float:
    """Round up to one of 1, 2, 5, 10, ..."""
    power = 10.0 ** np.floor(np.log10(least))
    return float(power * min(step for step in (1.0, 2.0, 5.0, 10.0) if step >= least / power))


def heat_map(values: Array, size: tuple[float, float], dots: Array, unit: str, label: str) -> str:
    """Draw positive values (R, C) on a grid from edge to edge, with interpolation; empty if none is finite.

    nan is unknown, and R and C are at least 2. `size` and the places `dots` (N, 2) to mark have one unit.
    `unit` is that of the values, for the scale below the map, and `label` is for screen readers.
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
    each, font = width / (_LEVELS + 1.5), 0.36 * margin
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
        if k % 2 == 0:
            parts += (
                f'<text x="{x:.6g}" y="{height + 0.95 * margin:.6g}" font-size="{font:.3g}">{text}</text>'
            )
    return parts
