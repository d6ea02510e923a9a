"""Backgrounds that tempt a detector: blocks, lines, gradients, discs and checkers that are no board."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.simulation.rendering.layers import half_plane
from neurocal_cli.simulation.rendering.scene import Background

_REFERENCE_AREA = 640 * 480  # px^2
_REFERENCE_SCALE = 40  # px


@frozen_dataclass
class Clutter(Background):
    """A background with things strewn over it.

    Parameters
    ----------
    kinds : tuple of str
        Of things, from ``KINDS``; none leaves it plain.
    amount : int
        Things of each kind in 640 x 480 pixels at a scale of 40 px; they cover the same share of
        any image at any scale.
    scale : float [px]
        Typical size of a thing; 0 takes 1/12 of the image's height.
    seed : int
    """

    kinds: tuple[str, ...] = ()
    amount: int = 25
    scale: float = 0.0
    seed: int = 0

    def image(self, size: tuple[int, int], pad: int) -> Array:
        """Reflectance, a border included; the same inside whatever the border."""
        width, height = size
        image = super().image(size, pad)
        rng = np.random.default_rng(self.seed)
        scale = self.scale or height / 12
        count = round(self.amount * (width * height / _REFERENCE_AREA) * (_REFERENCE_SCALE / scale) ** 2)
        for kind in self.kinds:
            for _ in range(max(count, 1)):
                # Drawn somewhat beyond the frame too, so that its borders are no emptier.
                place = rng.uniform(-0.1, 1.1, 2) * size
                _DRAW[kind](_Canvas(image, pad), rng, place, scale)
        return image


class _Canvas:
    """An image that shapes are drawn on with smooth edges."""

    def __init__(self, image: Array, pad: int) -> None:
        self.image = image
        self.pad = pad

    def rectangle(self, centre: Array, size: Array, angle: float, level: float) -> None:
        """Draw a filled rectangle of size (w, h) [px], turned by an angle [rad]."""
        c, s = np.cos(angle), np.sin(angle)
        reach = float(0.5 * np.hypot(*size)) + 1

        def share(du: Array, dv: Array) -> Array:
            inside = np.ones_like(du)
            for length, nu, nv in ((size[0], c, s), (size[1], -s, c)):
                inward = 0.5 * length - np.abs(nu * du + nv * dv)
                inside *= half_plane(inward, np.full_like(du, nu), np.full_like(du, nv), 1.0)[0]
            return inside

        self._blend(centre, reach, share, level)

    def disc(self, centre: Array, radius: float, level: float) -> None:
        """Draw a filled disc."""

        def share(du: Array, dv: Array) -> Array:
            away = np.maximum(np.hypot(du, dv), 1e-9)
            return half_plane(radius - away, du / away, dv / away, 1.0)[0]

        self._blend(centre, radius + 1, share, level)

    def gradient(self, centre: Array, size: float, angle: float, step: float) -> None:
        """Add a smooth hill that rises along one direction."""
        rows, columns, du, dv = self._window(centre, 3 * size)
        if not du.size:
            return
        x, y = du[:1] / size, dv[:, :1] / size
        hill = (np.cos(angle) * x + np.sin(angle) * y) * (step * np.exp(-0.5 * x**2)) * np.exp(-0.5 * y**2)
        self.image[rows, columns] = np.clip(self.image[rows, columns] + hill, 0.02, 1.0)

    def _blend(
        self, centre: Array, reach: float, share: Callable[[Array, Array], Array], level: float
    ) -> None:
        rows, columns, du, dv = self._window(centre, reach)
        if du.size:
            alpha = share(du.ravel(), dv.ravel()).reshape(du.shape)
            self.image[rows, columns] += alpha * (level - self.image[rows, columns])

    def _window(self, centre: Array, reach: float) -> tuple[slice, slice, Array, Array]:
        """Rows, columns and offsets from the centre of the pixels within reach."""
        height, width = self.image.shape
        u, v = float(centre[0]) + self.pad, float(centre[1]) + self.pad
        left, right = (int(np.clip(round(u + d), 0, width)) for d in (-reach - 1, reach + 2))
        top, bottom = (int(np.clip(round(v + d), 0, height)) for d in (-reach - 1, reach + 2))
        du, dv = np.meshgrid(np.arange(left, right) - u, np.arange(top, bottom) - v)
        return slice(top, bottom), slice(left, right), du, dv


def _block(canvas: _Canvas, rng: np.random.Generator, place: Array, scale: float) -> None:
    size = scale * rng.uniform(0.2, 1.6, 2)
    canvas.rectangle(place, size, rng.uniform(0, np.pi), rng.uniform(0.03, 0.97))


def _line(canvas: _Canvas, rng: np.random.Generator, place: Array, scale: float) -> None:
    size = scale * np.array([rng.uniform(2.0, 8.0), rng.uniform(0.03, 0.15)])
    canvas.rectangle(place, size, rng.uniform(0, np.pi), rng.uniform(0.03, 0.97))


def _gradient(canvas: _Canvas, rng: np.random.Generator, place: Array, scale: float) -> None:
    canvas.gradient(place, scale * rng.uniform(0.5, 2.0), rng.uniform(0, 2 * np.pi), rng.uniform(-0.5, 0.5))


def _disc(canvas: _Canvas, rng: np.random.Generator, place: Array, scale: float) -> None:
    canvas.disc(place, scale * rng.uniform(0.1, 0.8), rng.uniform(0.03, 0.97))


def _decoy(canvas: _Canvas, rng: np.random.Generator, place: Array, scale: float) -> None:
    """Draw single saddles, rows of squares and ragged checkers: all without a grid of 3 x 3 vertices."""
    side = scale * rng.uniform(0.15, 0.5)
    angle = rng.uniform(0, np.pi)
    c, s = np.cos(angle), np.sin(angle)
    dark, bright = rng.uniform(0.03, 0.35), rng.uniform(0.6, 0.97)
    kind = rng.integers(3)
    columns, rows = ((2, 2), (int(rng.integers(4, 9)), 2), (5, 5))[kind]
    for j in range(rows):
        for i in range(columns):
            local = side * np.array([i - 0.5 * (columns - 1), j - 0.5 * (rows - 1)])
            size, turn = np.full(2, side), 0.0
            if kind == 2:  # every square out of place and shape, so that no edge goes on in another
                local += rng.uniform(-0.3, 0.3, 2) * side
                size, turn = side * rng.uniform(0.6, 1.1, 2), rng.uniform(-0.4, 0.4)
            where = place + np.array([c * local[0] - s * local[1], s * local[0] + c * local[1]])
            canvas.rectangle(where, size, angle + turn, dark if (i + j) % 2 else bright)


_DRAW: dict[str, Callable[[_Canvas, np.random.Generator, Array, float], None]] = {
    "blocks": _block,
    "lines": _line,
    "gradients": _gradient,
    "discs": _disc,
    "decoys": _decoy,
}
KINDS = tuple(_DRAW)
