"""Draw detections: points, labels and residuals over the dimmed image."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.homographies import homographies, homography_at
from neurocal_cli.detection.detect import Detection, label
from neurocal_cli.detection.grid import EDGE_H, EDGE_V, VERTEX, Grid, Measured
from neurocal_cli.detection.identify import Located
from neurocal_cli.detection.wide_lens import fit_wide_lens

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

_WIDTH = 1500  # px of a picture; smaller images are enlarged by a whole factor
_LINE = 26  # px, height of a line of text
_CHARACTER = 10  # px, approximate width of a character
_SHIFT = 4  # fractional bits of drawn coordinates
_ARROW = 0.25  # squares; greatest drawn length of a median residual
_FEWEST_WIDE = 12  # points needed for the equidistant lens
_POINTS_A_TERM = 6  # least number of points per coefficient of the polynomial; for pictures only
_SCALES = tuple(m * 10**e for e in range(6) for m in (1, 2, 5))

_KINDS = {EDGE_H: "h orange", EDGE_V: "v cyan", VERTEX: "vertex green"}
_COLOURS: dict[int, Colour] = {EDGE_H: (255, 170, 0), EDGE_V: (0, 220, 255), VERTEX: (120, 255, 120)}
_RESIDUAL: Colour = (255, 70, 70)
_WHITE: Colour = (255, 255, 255)
_X_AXIS: Colour = (255, 60, 200)
_Y_AXIS: Colour = (150, 255, 0)
_GRIDS: tuple[Colour, ...] = ((255, 170, 0), (0, 220, 255), (120, 255, 120), (255, 60, 200), (255, 255, 90))


def draw_detection(grey: NDArray[np.generic], detection: Detection) -> Picture:
    """Draw the points of a detection over a grey image; (height, width, 3) in the order red, green, blue.

    Crosses are the measured points, coloured by kind. Red lines are the residuals from a smooth map of the
    plane (`plane_residuals`), enlarged by the factor in the title. A circle marks vertex (0, 0), from which
    the axes of the plane start; the outermost vertices carry their ids.
    """
    residuals = [
        plane_residuals(measured, detection.image_size, located)
        for located, measured in zip(detection.located, detection.measured, strict=True)
    ]
    lengths = np.concatenate([np.hypot(*residual.T) for residual in residuals])
    square = min(one.grid.square for one in detection.located)
    typical = max(float(np.median(lengths)), 1e-9)
    scale = max((scale for scale in _SCALES if scale * typical <= _ARROW * square), default=1)
    pairs = zip(detection.located, detection.measured, strict=True)
    kinds = [label(located, measured).kind for located, measured in pairs]
    every = np.concatenate(kinds)
    counts = [f"{name} ({n})" for kind, name in _KINDS.items() if (n := np.count_nonzero(every == kind))]
    offsets = ", ".join(f"{round(measured.polarity, 3) + 0.0:+.3f}" for measured in detection.measured)
    lines = [
        f"{len(detection.ids)} points, {detection.rejected} rejected; residuals x {scale}: rms "
        f"{np.sqrt((lengths**2).mean()):.3g} px, largest {lengths.max():.3g} px",
        f"circles green ({len(every)})"
        if any(one.circles is not None for one in detection.located)
        else f"{', '.join(counts)}; edges displaced by {offsets} px before correction",
    ]
    canvas = _Canvas(grey, lines)
    grids = zip(detection.located, detection.measured, residuals, kinds, strict=True)
    for located, measured, residual, kinds_of in grids:
        for pixel, arrow in zip(measured.pixels, residual * scale, strict=True):
            canvas.line(pixel, pixel + arrow, _RESIDUAL)
        for pixel, kind in zip(measured.pixels, kinds_of.tolist(), strict=True):
            canvas.cross(pixel, _COLOURS[kind])
        _draw_frame(canvas, located, measured)
    return canvas.picture


def draw_failure(grey: NDArray[np.generic], grids: Sequence[Grid], problem: str) -> Picture:
    """Draw the grids found in an image in which the board was not detected, with the reason."""
    sizes = ", ".join("{} x {}".format(*grid.shape) for grid in grids) or "none"
    canvas = _Canvas(grey, [problem, f"grids found: {sizes}"])
    for k, grid in enumerate(grids):
        for pixel in grid.pixels[grid.seen]:
            canvas.cross(pixel, _GRIDS[k % len(_GRIDS)])
    return canvas.picture


def _draw_frame(canvas: _Canvas, located: Located, measured: Measured) -> None:
    """Draw the origin, the axes and the ids of the outermost vertices found."""
    pixels = np.where(np.isfinite(measured.vertices), measured.vertices, located.grid.pixels)
    rows, columns = np.nonzero(np.isfinite(pixels[..., 0]))
    places = np.rint(located.placement.apply(np.stack([columns, rows], axis=-1))).astype(int)
    at = {(x, y): pixels[r, c] for (x, y), r, c in zip(places.tolist(), rows, columns, strict=True)}
    for tip, colour, name in (((2, 0), _X_AXIS, "x"), ((0, 2), _Y_AXIS, "y")):
        if (0, 0) in at and tip in at:
            canvas.arrow(at[0, 0], at[tip], colour)
            canvas.text(at[tip], name, colour)
    if (0, 0) in at:
        canvas.circle(at[0, 0], _WHITE)
    for key in sorted({min(at, key=lambda p: p[0] * a + p[1] * b) for a in (-1, 1) for b in (-1, 1)}):
        canvas.text(at[key], located.plane.label("", *key), _WHITE)


class _Canvas:
    """A dimmed image below lines of text; drawing uses the coordinates of the image."""

    def __init__(self, grey: NDArray[np.generic], lines: Sequence[str]) -> None:
        height, width = grey.shape
        self.scale = max(1, _WIDTH // width) if width <= _WIDTH else _WIDTH / width
        size = (max(1, round(width * self.scale)), max(1, round(height * self.scale)))
        method = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_NEAREST
        small = cv2.resize(_dimmed(grey), size, interpolation=method)
        room = max(10, (size[0] - 12) // _CHARACTER)
        texts = [line[k : k + room] for line in lines for k in range(0, len(line), room)]
        self.top = _LINE * len(texts) + 8
        self.picture = np.zeros((size[1] + self.top, size[0], 3), dtype=np.uint8)
        self.picture[self.top :] = small[..., None]
        for k, text in enumerate(texts):
            _put(self.picture, text, (6, _LINE * (k + 1) - 6), _WHITE, 0.55)

    def line(self, start: ArrayLike, stop: ArrayLike, colour: Colour) -> None:
        cv2.line(self.picture, self._at(start), self._at(stop), colour, 1, cv2.LINE_AA, _SHIFT)

    def cross(self, pixel: ArrayLike, colour: Colour) -> None:
        u, v = self._at(pixel)
        arm = 3 << _SHIFT
        cv2.line(self.picture, (u - arm, v), (u + arm, v), colour, 1, cv2.LINE_AA, _SHIFT)
        cv2.line(self.picture, (u, v - arm), (u, v + arm), colour, 1, cv2.LINE_AA, _SHIFT)

    def circle(self, pixel: ArrayLike, colour: Colour) -> None:
        cv2.circle(self.picture, self._at(pixel), 8 << _SHIFT, colour, 2, cv2.LINE_AA, _SHIFT)

    def arrow(self, start: ArrayLike, stop: ArrayLike, colour: Colour) -> None:
        cv2.arrowedLine(self.picture, self._at(start), self._at(stop), colour, 2, cv2.LINE_AA, _SHIFT, 0.12)

    def text(self, pixel: ArrayLike, text: str, colour: Colour) -> None:
        u, v = self._at(pixel)
        _put(self.picture, text, ((u >> _SHIFT) + 7, (v >> _SHIFT) - 7), colour, 0.5)

    def _at(self, pixel: ArrayLike) -> tuple[int, int]:
        """Position in the picture, in units of 1/16 px; pixel centres are mapped to pixel centres."""
        u, v = (np.asarray(pixel) + 0.5) * self.scale - 0.5
        limit = 1 << 24  # keeps outliers from overflowing
        u, v = np.clip([u, v + self.top], -limit >> _SHIFT, limit >> _SHIFT)
        return round(float(u) * (1 << _SHIFT)), round(float(v) * (1 << _SHIFT))


def _dimmed(grey: NDArray[np.generic]) -> Picture:
    """Map grey values to 20 to 130 in steps of 5: darker than the crosses, and a smaller file."""
    step = max(1, max(grey.shape) // 500)
    low, high = np.percentile(grey[::step, ::step].astype(float), [1, 99])
    share = np.clip((grey.astype(np.float32) - low) / max(float(high - low), 1.0), 0, 1)
    return (20 + 5 * np.rint(22 * share)).astype(np.uint8)


def _put(picture: Picture, text: str, place: tuple[int, int], colour: Colour, size: float) -> None:
    plain = text.encode("ascii", "replace").decode()  # the font has no other characters
    cv2.putText(picture, plain, place, cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(picture, plain, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def plane_residuals(
    measured: Measured, size: tuple[int, int] | None = None, located: Located | None = None
) -> Array:
    """Residuals (N, 2) [px] of points from a smooth map of their plane, to show the noise without a camera.

    The plane is projected by a pinhole or an equidistant lens, whichever fits better; only by a pinhole if
    the size of the image is not given. A polynomial models the deviations of the real lens; its degree is
    five, or less for few points. Residuals are zero for fewer than five points, because a homography fits
    four exactly. The plane that was `located` tells where its lines are, if not at equal distances.
    """
    grid = measured.index + 0.5 * np.stack([measured.kind == EDGE_H, measured.kind == EDGE_V], axis=-1)
    if located is not None:
        grid = located.plane.spread(located.placement.apply(grid))
    if len(grid) < 5:
        return np.zeros_like(measured.pixels)
    seen = homography_at(homographies(grid[None], measured.pixels[None]), grid[None])[0]
    left = measured.pixels - seen
    if size is not None and len(grid) >= _FEWEST_WIDE:
        wide = fit_wide_lens(grid, measured.pixels, size).residual
        left = wide if (wide**2).sum() < (left**2).sum() else left
    degree = max((d for d in range(1, 6) if _POINTS_A_TERM * (d + 1) * (d + 2) <= 2 * len(grid)), default=0)
    x, y = ((grid - grid.mean(axis=0)) / max(float(np.ptp(grid)), 1.0)).T
    terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=-1)
    return np.asarray(left - terms @ np.linalg.lstsq(terms, left, rcond=None)[0])
