"""Images that are resized, binned or cropped, and what becomes of the camera that took them.

A pixel is a square, and its centre has whole coordinates. An image that is scaled by s keeps its edges, from
-1/2 to w - 1/2, so ``u' = (u + 1/2) s - 1/2``. A binned pixel covers n x n pixels: the same with s = 1/n. The
distortion acts on normalised points and does not change, and neither does the angle of the image axes.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import InputError, UsageError

_STRETCHED = 0.01  # difference of both scales that is no rounding of the size


@frozen_dataclass
class Resizing:
    """A scale in u and in v, and then a part of the image."""

    scale: tuple[float, float] = (1.0, 1.0)
    corner: tuple[int, int] = (0, 0)  # pixel of the scaled image that becomes (0, 0)
    size: tuple[int, int] | None = None  # width and height of the result [px]

    @property
    def stretch(self) -> float:
        """The scale in u over that in v; exactly 1 if they differ by the rounding of the size."""
        ratio = self.scale[0] / self.scale[1]
        return ratio if abs(ratio - 1) > _STRETCHED else 1.0

    @property
    def mean(self) -> float:
        """Geometric mean of the scales in u and in v."""
        return float(np.sqrt(self.scale[0] * self.scale[1]))

    def intrinsics(self, old: Intrinsics) -> Intrinsics:
        """Intrinsic parameters of the new images; theta stays, because A11 and A12 have one scale."""
        (a, b), (left, top) = self.scale, self.corner
        u0, v0 = (old.u0 + 0.5) * a - 0.5 - left, (old.v0 + 0.5) * b - 0.5 - top
        return Intrinsics(a * old.alpha_u, b * old.alpha_v, u0, v0, old.theta)

    @property
    def factors(self) -> dict[str, float]:
        """By how much the parameters that change, and their standard deviations, are multiplied."""
        a, b = self.scale
        return {"alpha_u": a, "alpha_v": b, "u0": a, "v0": b}


def resizing(
    old: tuple[int, int] | None,
    *,
    to: tuple[int, int] | None = None,
    scale: float | None = None,
    crop: tuple[int, int, int, int] | None = None,
    binning: int | None = None,
) -> Resizing:
    """The change of images of the size `old`, by exactly one of the options.

    `to` is the new size of the whole image, and `crop` the left, top, width and height of the part that is
    kept [px]. With `scale`, new over old, the new size is rounded. With `binning`, as many pixels along u and
    along v become one, and those left over at the right and the bottom are dropped. Raises UsageError for
    none or several, and InputError for a part or a size that does not exist.
    """
    if sum(option is not None for option in (to, scale, crop, binning)) != 1:
        raise UsageError("give one of --to W H, --scale S, --crop U V W H and --binning N")
    if to is not None:
        if old is None:
            raise InputError("the size of the images is not known; give --scale instead of --to")
        return Resizing((to[0] / old[0], to[1] / old[1]), (0, 0), to)
    if crop is not None:
        left, top, width, height = crop
        inside = old is None or (left + width <= old[0] and top + height <= old[1])
        if min(left, top) < 0 or min(width, height) < 1 or not inside:
            of = "" if old is None else f" of {old[0]} x {old[1]} px"
            raise InputError(f"--crop {left} {top} {width} {height} reaches out of the image{of}")
        return Resizing((1.0, 1.0), (left, top), (width, height))
    factor = 1 / binning if binning is not None else scale
    if factor is None or not (np.isfinite(factor) and factor > 0):
        raise InputError(f"the scale of an image must be positive, found {factor}")
    size = None
    if old is not None:
        width, height = (
            (old[0] // binning, old[1] // binning)
            if binning is not None
            else (round(old[0] * factor), round(old[1] * factor))
        )
        if min(width, height) < 1:
            raise InputError(f"nothing is left of an image of {old[0]} x {old[1]} px; give another factor")
        size = width, height
    return Resizing((factor, factor), (0, 0), size)
