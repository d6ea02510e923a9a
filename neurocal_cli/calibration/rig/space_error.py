"""Errors of points in space: over all points, by frame and by depth, and NSCE.

They are in the frame of the first, or left, camera, with z along its optical axis.

The normalised stereo calibration error (NSCE) of Weng, Cohen and Herniou (1992) compares the error across the
line of sight with the size of a pixel at the depth of the point.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import DegenerateGeometryError

_MOST_DEPTHS = 5  # rows of the table of depths
_POINTS_PER_DEPTH = 20


@frozen_dataclass
class DepthError:
    """Errors of the points in an interval of depths."""

    nearest: float  # [world unit]
    farthest: float
    n_points: int
    rmse: float  # [world unit]
    relative: float  # rms of the error over the depth


@frozen_dataclass(eq=False)
class SpaceError:
    """Errors of triangulated points, in the first, or left, camera's frame [world unit]."""

    n_points: int  # in the averages
    n_behind: int  # triangulated behind a camera, and in no average
    rmse: float  # sqrt(mean(dX^2 + dY^2 + dZ^2))
    rmse_x: float  # of each axis; their squares add up to the square of `rmse`
    rmse_y: float
    rmse_z: float
    max: float  # longest error
    nsce: float  # normalised stereo calibration error: 1 is the rounding to whole pixels
    epipolar_px: float  # rms of the smallest shift of both pixels that makes their rays intersect [px]
    relative: float  # rms of the error over the depth
    views: Mapping[str, tuple[int, float]]  # number of points and rmse by frame, or by the left camera's view
    depths: tuple[DepthError, ...]  # the nearest first, with about the same number of points
    errors: Array  # (N, 3) triangulated minus true; nan for points behind a camera


def space_error(
    triangulated: Array,
    true: Array,
    epipolar: Array,
    view: NDArray[np.intp],
    names: list[str],
    camera: Intrinsics,
) -> SpaceError:
    """Compare triangulated points with their true positions (N, 3), both in the first camera's frame.

    Rows of `triangulated` that are nan count as behind; an error if all are. `epipolar` (N,) is in pixels,
    `view` (N,) are indices into `names`, and `camera` is the first one, for NSCE.
    """
    errors = triangulated - true
    fine = np.isfinite(errors).all(axis=1)
    if not fine.any():
        raise DegenerateGeometryError(
            "every triangulated point is behind a camera; check that the points of each camera are its own"
        )
    e, depth = errors[fine], triangulated[fine, 2]
    squares = (e**2).sum(axis=1)
    axes = np.sqrt((e**2).mean(axis=0))
    # Rms of the rounding to whole pixels at the depth of the point: Z / (alpha sqrt(12)).
    rounding = depth**2 * (camera.alpha_u**-2 + camera.alpha_v**-2) / 12
    counts = np.bincount(view[fine], minlength=len(names))
    sums = np.bincount(view[fine], weights=squares, minlength=len(names))
    present = np.bincount(view, minlength=len(names)) > 0
    return SpaceError(
        n_points=int(fine.sum()),
        n_behind=int((~fine).sum()),
        rmse=float(np.sqrt(squares.mean())),
        rmse_x=float(axes[0]),
        rmse_y=float(axes[1]),
        rmse_z=float(axes[2]),
        max=float(np.sqrt(squares.max())),
        nsce=float(np.sqrt((e[:, 0] ** 2 + e[:, 1] ** 2) / rounding).mean()),
        epipolar_px=float(np.sqrt((epipolar[fine] ** 2).mean())),
        relative=float(np.sqrt((squares / depth**2).mean())),
        views={
            name: (int(counts[k]), float(np.sqrt(sums[k] / counts[k])) if counts[k] else float("nan"))
            for k, name in enumerate(names)
            if present[k]
        },
        depths=_by_depth(squares, true[fine, 2], depth),
        errors=errors,
    )


def _by_depth(squares: Array, true: Array, triangulated: Array) -> tuple[DepthError, ...]:
    order = np.argsort(true, kind="stable")
    parts = np.array_split(order, max(1, min(_MOST_DEPTHS, len(order) // _POINTS_PER_DEPTH)))
    return tuple(
        DepthError(
            float(true[part[0]]),
            float(true[part[-1]]),
            len(part),
            float(np.sqrt(squares[part].mean())),
            float(np.sqrt((squares[part] / triangulated[part] ** 2).mean())),
        )
        for part in parts
    )
