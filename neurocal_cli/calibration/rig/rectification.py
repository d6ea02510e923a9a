"""Rectification: two virtual cameras, side by side, whose rows (or columns) correspond.

R1, R2, P1, P2 and Q are those of OpenCV's ``stereoRectify`` (Bouguet), with zero disparity at infinity. Each
camera is turned by half of the rig's rotation. Both are then turned together until the baseline is
parallel to an axis, the one along its longer component. If the right camera is mounted upside down or on its
side, its image is first turned by quarters until it is as upright as the left one.

`rectify` finds the matrices, and `rectified_pair` the cameras, for which points and pictures are converted.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.rig.frames import pair_points, pair_views
from neurocal_cli.calibration.rig.rig import StereoRig
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, cross_matrix, euler_to_rotation, nearest_rotation
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.undistortion import plane_like
from neurocal_cli.errors import DegenerateGeometryError, InputError, UsageError
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.undistorted_points import map_points, shown

_GRID = 9  # samples along each side of the image, as in OpenCV
_WIDEST = 5.0  # tangent of 79 degrees: the widest angle that scales an image, and from an axis to its plane's
_ACROSS = 0.7  # least cosine of a measured direction to the one across the rows, 45 degrees
_LINES = 16  # over the images
_QUARTERS = tuple(euler_to_rotation(0.0, 0.0, np.radians(d)).round() for d in (0, 90, 180, 270))
_COLOURS = ((255, 80, 60), (60, 200, 255), (120, 255, 120), (255, 220, 60))


@frozen_dataclass(eq=False)
class Rectification:
    """Rectified cameras."""

    R1: Array  # (3, 3) from each camera's frame to its rectified one
    R2: Array
    P1: Array  # (3, 4) projections from the left rectified frame into both rectified images
    P2: Array
    Q: Array  # (4, 4) (u, v, disparity, 1) of the left image to homogeneous points in its rectified frame


def rectify(rig: StereoRig, alpha: float | None = None) -> Rectification | None:
    """Rectify a rig; None if the image sizes are unknown or differ, or the cameras face away from each other.

    The rectified images are scaled by alpha. With 0 all their pixels are valid, with 1 they contain all
    pixels of the original images, and values in between interpolate. With None nothing is scaled. The
    focal length is negative, as OpenCV's, where the optical axes differ so much that no scale does this.
    """
    if alpha is not None and not 0 <= alpha <= 1:
        raise UsageError(f"alpha must be between 0 and 1, not {alpha:g}")
    size = _size(rig)
    if size is None or np.tan(0.5 * np.arccos(np.clip(rig.R[2, 2], -1.0, 1.0))) > _WIDEST:
        return None
    quarter = max(_QUARTERS, key=lambda turn: float((turn * rig.R.T).sum()))
    half = nearest_rotation(quarter @ rig.R + np.eye(3))  # its square is R, so turned
    t = half.T @ quarter @ rig.t
    axis = 0 if abs(t[0]) > abs(t[1]) else 1
    turn = _shortest_turn(t, np.eye(3)[axis] * (1.0 if t[axis] > 0 else -1.0))
    rotations = turn @ half, turn @ half.T @ quarter
    cameras = [(rig.left.camera, rotations[0]), (rig.right.camera, rotations[1])]
    along = float((rotations[1] @ rig.t)[axis])
    f = 0.5 * float(sum(plane_like(camera).A[1 - axis, 1 - axis] for camera, _ in cameras))
    centres = [_centre(camera, R, f, size) for camera, R in cameras]
    centre = 0.5 * (centres[0] + centres[1])  # one for both: disparity 0 at infinity
    if alpha is not None:
        f *= _scale(cameras, f, centre, size, alpha)
    P1 = np.array([[f, 0.0, centre[0], 0.0], [0.0, f, centre[1], 0.0], [0.0, 0.0, 1.0, 0.0]])
    P2 = P1.copy()
    P2[axis, 3] = f * along
    Q = np.zeros((4, 4))
    Q[:2, :2], Q[:2, 3], Q[2, 3], Q[3, 2] = np.eye(2), -centre, f, -1.0 / along
    return Rectification(*rotations, P1, P2, Q)


def must_rectify(rig: StereoRig, alpha: float | None, advice: str) -> Rectification:
    """Rectify a rig, or raise why not; the advice is how to give an image size."""
    found = rectify(rig, alpha)
    if found is not None:
        return found
    if _size(rig) is None:
        raise InputError(f"both cameras must have images of one known size to be rectified; {advice}")
    raise DegenerateGeometryError(
        "the cameras face away from each other, so no plane shows what both see; triangulate original pixels"
    )


def _size(rig: StereoRig) -> tuple[int, int] | None:
    """Width and height of both images; None where they are unknown or differ."""
    return rig.left.image_size if rig.left.image_size == rig.right.image_size else None


def _shortest_turn(a: Array, b: Array) -> Array:
    """The rotation about the normal of both that takes the direction of a to the unit vector b."""
    a = a / np.linalg.norm(a)
    K = cross_matrix(np.cross(a, b))
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + a @ b))


def _centre(camera: Camera, R: Array, f: float, size: tuple[int, int]) -> Array:
    """Principal point that centres the corners of the image in the rectified one, its middle if wide."""
    last = np.array(size, dtype=float) - 1
    if camera.distortion.wide:  # the corners are far out, or behind
        middle = _rectified(camera, R, last[None] / 2)[0]
        return np.asarray(0.5 * last - f * (middle if np.isfinite(middle).all() else 0.0))
    corners = _rectified(camera, R, np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * last)
    if not np.isfinite(corners).all():  # beyond the distortion: the middles of the sides
        corners = _rectified(camera, R, np.array([[0.5, 0], [0.5, 1], [0, 0.5], [1, 0.5]]) * last)
    middle = corners.mean(axis=0) if np.isfinite(corners).all() else np.zeros(2)
    return np.asarray(0.5 * last - f * middle)


def _scale(
    cameras: list[tuple[Camera, Array]], f: float, centre: Array, size: tuple[int, int], alpha: float
) -> float:
    """Factor of the focal length."""
    last = np.array(size, dtype=float) - 1
    grid = np.linspace(0.0, 1.0, _GRID)
    pixels = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2) * last
    room = np.array([centre, last - centre])  # to the left and top, to the right and bottom
    fill, hold = [], []
    for camera, R in cameras:
        image = f * _rectified(camera, R, pixels).clip(-_WIDEST, _WIDEST).reshape(_GRID, _GRID, 2)
        # What is behind sets no limit.
        near = [np.fmax.reduce(side, initial=-f * _WIDEST) for side in (image[:, 0, 0], image[0, :, 1])]
        far = [np.fmin.reduce(side, initial=f * _WIDEST) for side in (image[:, -1, 0], image[-1, :, 1])]
        inner = np.array([near, far])
        outer = np.array([np.nanmin(image, axis=(0, 1)), np.nanmax(image, axis=(0, 1))])
        signs = np.array([[-1.0], [1.0]])
        fill.append((room / (signs * inner)).max())
        hold.append((room / (signs * outer)).min())
    return float((1 - alpha) * max(fill) + alpha * min(hold))


def _rectified(camera: Camera, R: Array, pixels: Array) -> Array:
    """Normalised rectified points of pixels, (N, 2).

    nan where the distortion does not reach a pixel, and where its ray is behind the rectified image plane.
    """
    rays = camera.unproject(pixels) @ R.T
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(rays[:, 2:] > 0, rays[:, :2] / rays[:, 2:], np.nan)


@frozen_dataclass(eq=False)
class RectifiedPair:
    """The cameras of a rig, left and right, and the rectified ones."""

    matrices: Rectification
    originals: tuple[Camera, Camera]
    cameras: tuple[Camera, Camera]  # without distortion, in the frames of R1 and R2
    axis: int  # 0: the cameras stand beside each other, and rows correspond; 1: above each other, and columns

    @property
    def rotations(self) -> tuple[Array, Array]:
        """R1 and R2, (3, 3) each."""
        return self.matrices.R1, self.matrices.R2


def rectified_pair(rig: StereoRig, alpha: float | None = None) -> RectifiedPair:
    """Rectify the cameras of a rig, whose images must have one known size; see `rectify`."""
    matrices = must_rectify(rig, alpha, "put image_width and image_height into the rig's file")
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
    return RectifiedPair(matrices, originals, (cameras[0], cameras[1]), axis)


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


@frozen_dataclass
class RowError:
    """Distance between the rows (or columns) of corresponding points [px]."""

    median_px: float
    rms_px: float
    max_px: float
    n_points: int


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


def row_error_of_rig(rig: StereoRig, pair: RectifiedPair) -> RowError | None:
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
