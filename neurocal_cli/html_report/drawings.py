"""SVG drawings for a page: residuals in the image, their scatter, and errors by view.

Colours come from the style of the page, so they suit its light and dark modes.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from html import escape

import numpy as np

from neurocal_cli.geometry import Array

_MOST = 4000  # greatest number of vectors in a drawing
_LONG = 0.04  # length of a residual of three times the rms, as a share of the image's width


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
    """Draw residuals as enlarged lines from their points, in an empty frame or over the photograph.

    Parameters
    ----------
    pixels, residuals : (N, 2) arrays [px]
    size : (width, height) [px]
    scale : float, optional
        Enlargement of the residuals; by default their `enlargement`.
    bold : float
        Factor on the thickness of lines, for small drawings.
    left_out : (M, 2) array, optional [px]
        Points to draw as crosses.
    photograph : bytes, optional
        The image as a JPEG file.
    """
    width, height = size
    scale = enlargement(residuals, size) if scale is None else scale
    step = -(-len(pixels) // _MOST)
    ends = pixels[::step] + scale * residuals[::step]
    path = "".join(
        f"M{u:.1f} {v:.1f}L{x:.1f} {y:.1f}" for (u, v), (x, y) in zip(pixels[::step], ends, strict=True)
    )
    dots = "".join(f"M{u:.1f} {v:.1f}h0" for u, v in pixels[::step])
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="residuals, {scale:.3g} times enlarged">'
        f'<rect width="{width}" height="{height}" class="frame"/>{_photograph(photograph, size)}'
        f'<path d="{dots}" class="dots" stroke-width="{bold * width / 160:.2f}"/>'
        f'<path d="{path}" class="lines" stroke-width="{bold * width / 450:.2f}"/>'
        f"{_crosses(left_out, width)}</svg>"
    )


def _photograph(jpeg: bytes | None, size: tuple[int, int]) -> str:
    """Embed the image, with pixel centres at whole numbers."""
    if jpeg is None:
        return ""
    data = b64encode(jpeg).decode()
    return (
        f'<image x="-.5" y="-.5" width="{size[0]}" height="{size[1]}" href="data:image/jpeg;base64,{data}"/>'
    )


def _crosses(pixels: Array | None, width: int) -> str:
    if pixels is None or not len(pixels):
        return ""
    arm = width / 100
    path = "".join(
        f"M{u - arm:.1f} {v - arm:.1f}L{u + arm:.1f} {v + arm:.1f}"
        f"M{u - arm:.1f} {v + arm:.1f}L{u + arm:.1f} {v - arm:.1f}"
        for u, v in pixels
    )
    return f'<path d="{path}" class="out" stroke-width="{width / 300:.2f}"/>'


def enlargement(residuals: Array, size: tuple[int, int]) -> float:
    """Round factor that makes residuals (N, 2) [px] visible in an image of a size [px]."""
    rms = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))) if len(residuals) else 0.0
    if not rms > 0:
        return 1.0
    wanted = _LONG * size[0] / (3 * rms)
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(m for m in (1, 2, 5) if m * power <= wanted))


def scatter(residuals: Array) -> str:
    """Draw residuals (N, 2) [px] as points, with a circle of three times the rms per coordinate."""
    sigma = float(np.sqrt(np.mean(residuals**2))) if len(residuals) else 0.0
    if not sigma > 0:
        return ""
    step = -(-len(residuals) // _MOST)
    shown = np.clip(residuals[::step] / sigma, -5.5, 5.5)
    dots = "".join(f"M{x:.2f} {y:.2f}h0" for x, y in shown)
    circles = '<circle r="3" class="axis"/>'
    labels = f'<text x="2.3" y="2.75" font-size="0.5">{3 * sigma:.2g} px</text>'
    return (
        '<svg viewBox="-6 -6 12 12" role="img" aria-label="du and dv of all points">'
        '<rect x="-6" y="-6" width="12" height="12" class="frame"/>'
        f'<path d="M-6 0H6M0 -6V6" class="axis" stroke-width="0.02"/>{circles}'
        f'<path d="{dots}" class="dots" stroke-width="0.11"/>{labels}</svg>'
    )


def error_bars(names: Sequence[str], errors: Sequence[float], overall: float) -> str:
    """Draw the rms error of each view as a bar, with a line at that of all points."""
    count = len(names)
    if not count or not max(errors, default=0) > 0:
        return ""
    most = 1.25 * max(max(errors), overall)
    width, height = 640.0, 220.0
    each = width / count
    bars = "".join(
        f'<rect x="{k * each + 0.1 * each:.1f}" y="{height * (1 - error / most):.1f}" '
        f'width="{0.8 * each:.1f}" height="{height * error / most:.1f}" class="bar">'
        f"<title>{escape(name)}: {error:.3g} px</title></rect>"
        for k, (name, error) in enumerate(zip(names, errors, strict=True))
    )
    line = height * (1 - overall / most)
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="rms error of each view">{bars}'
        f'<path d="M0 {line:.1f}H{width:.0f}" class="lines" stroke-width="1.5"/>'
        f'<text x="4" y="22" font-size="18">line: {overall:.3g} px, rms of all</text></svg>'
    )
