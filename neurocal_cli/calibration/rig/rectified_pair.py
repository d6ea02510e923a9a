"""The two rectified cameras of a rig: points converted to them, the error of their rows, and pictures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.rig.pairing import pair_points, pair_views
from neurocal_cli.calibration.rig.rectification import Rectification, rectify
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import DegenerateGeometryError, InputError
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.undistorted_points import map_points, shown

_ACROSS = 0.7  # least cosine of a measured direction to the one across the rows, 45 degrees
_LINES = 16  # over the images
_COLOURS = ((255, 80, 60), (60, 200, 255), (120, 255, 120), (255, 220, 60))


@frozen_dataclass(eq=False)
class RectifiedPair:
    """The rectified cameras of a rig."""

    matrices: Rectification
    originals: tuple[Camera, Camera]
    cameras: tuple[Camera, Camera]  # without distortion, in the frames of R1 and R2
    rotations: tuple[Array, Array]  # R1 and R2, (3, 3) each
    axis: int  # 0: the cameras stand beside each other, and rows correspond; 1: above each other, and columns


@frozen_dataclass
class RowError:
    """Distance between the rows (or columns) of corresponding points [px]."""

    median_px: float
    rms_px: float
    max_px: float
    n_points: int


def rectified_pair(rig: Rig, alpha: float | None = None) -> RectifiedPair:
    """Rectify the cameras of a rig, whose images must have one known size; see `rectification.rectify`."""
    matrices = rectify(rig, alpha)
    if matrices is None:
        raise InputError(
            "both cameras must have images of one known size to be rectified; put image_width and "
            "image_height into the rig's file"
        )
    if not matrices.P1[0, 0] > 0:
        raise DegenerateGeometryError(
            f"the optical axes of the cameras differ so much that rectified images cannot be scaled by alpha "
            f"{alpha:g}; leave alpha out"
        )
    originals = rig.left.camera, rig.right.camera
    cameras = [
        Camera(Intrinsics.from_matrix(P[:, :3]), Distortion(), camera.image_size, camera.name)
        for camera, P in zip(originals, (matrices.P1, matrices.P2), strict=True)
    ]
    axis = 0 if matrices.P2[0, 3] != 0 else 1
    return RectifiedPair(matrices, originals, (cameras[0], cameras[1]), (matrices.R1, matrices.R2), axis)


def rectify_points(pair: RectifiedPair, side: int, points: Correspondences) -> Correspondences:
    """Convert points of one camera, 0 left or 1 right, to its rectified camera.

    Points of a wide lens behind the rectified image plane are left out. Another image size and a pixel that
    the distortion does not reach are errors.
    """
    size = pair.cameras[side].image_size
    if points.image_size not in (None, size):
        raise InputError(
            f"{points.source}: the image_size is {points.image_size}, but the camera's is {size}; give the "
            "points of this camera"
        )
    views = pair.originals[side], pair.cameras[side], pair.rotations[side]
    moved = map_points(points.select(shown(points, *views)), *views)
    return replace(moved, image_size=size)


def row_error(pair: RectifiedPair, left: Correspondences, right: Correspondences) -> RowError:
    """Distance of the rows (columns, for cameras above each other) of the same points, rectified.

    The points are those that `rectify_points` returns; some must be in both. Mid-points that were measured
    only along the row are left out.
    """
    common = pair_points(left, right, pair_views(left.view_names, right.view_names))
    across = 1 - pair.axis
    difference = left.pixels[common.left, across] - right.pixels[common.right, across]
    kept = np.ones(len(difference), dtype=bool)
    for points, rows in ((left, common.left), (right, common.right)):
        if points.across is not None:
            n = points.across[rows]
            kept &= ~n.any(axis=1) | (np.abs(n[:, across]) > _ACROSS)
    if kept.any():
        difference = difference[kept]
    rms, size = float(np.sqrt(np.mean(difference**2))), np.abs(difference)
    return RowError(float(np.median(size)), rms, float(size.max()), len(size))


def row_error_of_rig(rig: Rig, pair: RectifiedPair) -> RowError | None:
    """Row error of the rig's own points in the pairs that determine it; None if it has no points."""
    if not rig.pairs or not len(rig.left.points) or not len(rig.right.points):
        return None
    moved = []
    for side, points in enumerate((rig.left.points, rig.right.points)):
        names = np.array([names[side] for names in rig.pairs])
        own = np.isin(np.array(points.view_names)[points.view_index], names)
        moved.append(rectify_points(pair, side, points.select(own)))
    return row_error(pair, moved[0], moved[1])


def pair_picture(left: NDArray[Any], right: NDArray[Any], axis: int) -> NDArray[np.uint8]:
    """Put two rectified images of one size together, with lines along which corresponding points lie.

    The images are (height, width) or (height, width, 3), uint8 or uint16. They are beside each other for the
    axis 0 and above each other for 1. The picture is (height, width, 3): red, green, blue.
    """
    whole = np.concatenate([_colours(left), _colours(right)], axis=1 - axis)
    across = whole.shape[axis]
    width = max(1, across // 500)
    for k in range(_LINES):
        place = round((k + 0.5) * across / _LINES)
        line = slice(place - width // 2, place - width // 2 + width)
        whole[line if axis == 0 else (slice(None), line)] = _COLOURS[k % len(_COLOURS)]
    return whole


def _colours(image: NDArray[Any]) -> NDArray[np.uint8]:
    """8 bits of red, green and blue."""
    pixels = image if image.dtype == np.uint8 else image >> 8
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[:, :, None], 3, axis=2)
    return np.array(pixels, dtype=np.uint8)
