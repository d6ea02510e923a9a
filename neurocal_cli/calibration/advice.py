"""Choose the views that reduce the uncertainty of a camera most, one after the other.

To the covariance of the calibration, each view adds the normal matrix of the camera's parameters with the
view's pose eliminated, ``A - C B^-1 C^T``. It needs no observed pixels, so views that were not taken can be
compared. All points have equal weight, with the noise of the calibration.

Changes of the camera that a motion of its frame compensates do not count, as in
`verdict.measures`. There the frame moves with the poses of the views. Here it moves so that
the pixels of near and far points all over the image move least, which does not depend on the views. So no
view can make the camera less certain, and the numbers of both modules are similar but not equal.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.calibration.calibration import Calibration, free_entries
from neurocal_cli.calibration.measurement import camera_and_root
from neurocal_cli.calibration.verdict.measures import image_grid
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import (
    Array,
    by_motion,
    cross_matrix,
    euler_to_rotation,
    median,
    nearest_rotation,
)
from neurocal_cli.camera.pinhole import Pose, in_cameras
from neurocal_cli.camera.rich_lens import NODES
from neurocal_cli.errors import InputError

_POSITIONS = (0.15, 0.325, 0.5, 0.675, 0.85)  # shares of the image's width and height
_WIDTHS = (0.3, 0.5, 0.75)  # width of the target as a share of the image's width
_TILTS = ((0.0, 0.0), *((tilt, way) for tilt in (25.0, 45.0) for way in range(0, 360, 45)))  # degrees
_ROLLS = (0.0, 90.0)  # degrees
_FROM_TO = np.array([0.5, 1.0, 2.0, 10.0])  # distances of judged points, relative to that of the views
_FLAT = 1e-6  # greatest ratio of thickness to size of a flat target
_MOST_VIEWS = 1000  # each takes time


@frozen_dataclass(eq=False)
class Candidate:
    """A possible view."""

    pose: Pose
    position: Array  # (2,) of the target's middle, as shares of the image's width and height
    width: float  # of the target in a frontal view, as a share of the image's width
    tilt: float  # [degrees]
    way: float  # direction of the side that comes nearer [degrees]: 0 is right, 90 is down
    roll: float  # clockwise rotation of the target in its plane [degrees]
    outline: Array  # (n, 2) corners of the target in the image [px]


@frozen_dataclass(eq=False)
class Advice:
    """Views to take next, in this order."""

    views: tuple[Candidate, ...]
    before: float  # largest standard deviation of a projected pixel without the views [px]
    after: tuple[float, ...]  # the same after adding each of the views [px]
    image_size: tuple[int, int]


def advise(calibration: Calibration, count: int = 3) -> Advice:
    """Choose views greedily: each reduces the largest uncertainty most, given the previous ones.

    Raises
    ------
    InputError
        The calibration has no points, no image size or no free parameter, no view shows the whole target, or
        the number of views is not 1 to 1000.
    """
    refuse_count(count)
    known, world = _Known.of(calibration), points_of_target(calibration)
    options = candidates(calibration)
    if not options:
        raise InputError("no view shows the whole target; check the image size and the target")
    told = [known.told(option.pose, world) for option in options]
    before, more = known.worst(), np.zeros_like(told[0])
    chosen, after = [], []
    for _ in range(count):
        values = [known.worst(more + view) for view in told]
        best = int(np.argmin(values))
        more = more + told[best]
        chosen.append(options[best])
        after.append(values[best])
    assert known.camera.image_size is not None
    return Advice(tuple(chosen), before, tuple(after), known.camera.image_size)


def refuse_count(count: int) -> None:
    """Refuse a number of views that is not positive, or larger than anyone takes, with an InputError."""
    if not 0 < count <= _MOST_VIEWS:
        raise InputError(f"the number of views must be 1 to {_MOST_VIEWS}, found {count}")


@frozen_dataclass(eq=False)
class _Known:
    """What is known of a camera: its errors are sums of f independent ones of standard deviation 1."""

    camera: Camera  # with coefficients that the choice of its model leaves open, as 0
    root: Array  # (5 + K, f) errors of A's entries [px] and the coefficients
    changes: Array  # (g, 2, f) those of the judged pixels [px], see `pixel_changes`
    sigma: float  # noise of the points [px]

    def told(self, pose: Pose, world: Array) -> Array:
        """(f, f) information of a view of points (N, 3)."""
        return self.root.T @ view_information(self.camera, pose, world) @ self.root / self.sigma**2

    def worst(self, more: Array | float = 0.0) -> float:
        """Largest standard deviation of a projected pixel [px], with the information of further views."""
        left = np.linalg.inv(np.eye(self.root.shape[1]) + more)
        return float(np.sqrt(((self.changes @ left) * self.changes).sum(axis=(1, 2)).max()))

    @classmethod
    def of(cls, calibration: Calibration) -> _Known:
        points, size = calibration.points, calibration.image_size
        if not len(points) or not calibration.views:
            raise InputError("the calibration holds no points; give a file that was not written with --lean")
        if size is None:
            raise InputError("the size of the images is unknown; calibrate with --image-size W H")
        if not free_entries(calibration).any():
            raise InputError("all parameters of the camera are given; more views cannot improve it")
        camera, root = camera_and_root(calibration, NODES)
        seen = in_cameras(
            [calibration.views[name].pose for name in points.view_names], points.world, points.view_index
        )
        away = np.linalg.norm(seen, axis=1) if camera.distortion.wide else seen[:, 2]
        places = pixel_changes(camera, image_grid(size), _FROM_TO * float(median(away)))
        return cls(camera, root, places @ root, calibration.sigma)


def points_of_target(calibration: Calibration) -> Array:
    """(n, 3) distinct points of the target."""
    points = calibration.points
    if calibration.target is not None:
        points = calibration.target.straightened(points)
    return np.asarray(np.unique(points.world, axis=0))


def candidates(calibration: Calibration) -> list[Candidate]:
    """Views with the whole target in the image, for all positions, widths, tilts and rolls."""
    camera, world = calibration.camera, points_of_target(calibration)
    assert camera.image_size is not None
    size = np.array(camera.image_size, dtype=float)
    middle = 0.5 * (world.min(axis=0) + world.max(axis=0))
    centred = world - middle
    frontal = _frontal(calibration, centred)
    corners = _outline(centred, frontal)
    extent = np.ptp(centred @ frontal.T, axis=0)[:2]
    turns = [(*tilt, roll) for tilt in _TILTS for roll in _ROLLS]
    rolled = {roll: euler_to_rotation(0, 0, np.radians(roll)) for roll in _ROLLS}
    R = np.array([_tilted(tilt, way) @ rolled[roll] @ frontal for tilt, way, roll in turns])
    # A flat target is in the image if its corners are.
    flat = np.ptp(centred @ frontal[2]) <= _FLAT * extent.max()
    checked = corners if flat else centred
    found = []
    for share in [(a, b) for b in _POSITIONS for a in _POSITIONS]:
        ray = camera.unproject((np.array(share) * (size - 1))[None])[0]
        if not (np.isfinite(ray).all() and ray[2] > 0):
            continue
        for width in _WIDTHS:
            depth = camera.A[0, 0] * float(extent.max()) / (width * size[0])
            centre = depth * ray / ray[2]
            points = checked @ np.swapaxes(R, 1, 2) + centre  # (turns, n, 3)
            for k in np.flatnonzero(camera.shows(points).all(axis=1)).tolist():
                pose = Pose(R[k], centre - R[k] @ middle)
                outline = camera.project(corners @ R[k].T + centre)[0]
                found.append(Candidate(pose, np.array(share), width, *turns[k], outline))
    return found


def _frontal(calibration: Calibration, centred: Array) -> Array:
    """Rotation of the frontal view, upright like the mean of the views."""
    mean = nearest_rotation(np.mean([view.pose.R for view in calibration.views.values()], axis=0))
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    if spread[2] > _FLAT * spread[0]:
        return np.asarray(mean)
    normal = axes[2] if mean[2] @ axes[2] > 0 else -axes[2]  # away from the camera
    right = mean[0] - (mean[0] @ normal) * normal
    if np.linalg.norm(right) < 1e-6:
        right = axes[0]
    right = right / np.linalg.norm(right)
    return np.array([right, np.cross(normal, right), normal])


def _outline(centred: Array, frontal: Array) -> Array:
    """(n, 3) points of the target on its convex outline in the frontal view, in order."""
    from scipy.spatial import ConvexHull

    flat = (centred @ frontal.T)[:, :2]
    return np.asarray(centred[ConvexHull(flat, qhull_options="QJ").vertices])


def _tilted(tilt: float, way: float) -> Array:
    """Rotation that brings the side in a direction of the image nearer; angles in degrees."""
    a, b = np.radians(tilt), np.radians(way)
    K = cross_matrix(np.array([-np.sin(b), np.cos(b), 0.0]))
    return np.asarray(np.eye(3) + np.sin(a) * K + (1 - np.cos(a)) * K @ K)


def view_information(camera: Camera, pose: Pose, world: Array) -> Array:
    """Information (5 + K, 5 + K) of a view of points (N, 3) on the camera.

    It is the normal matrix of A11, A12, A22, A13, A23 and the coefficients with the pose eliminated, for
    residuals of unit variance.
    """
    points = pose.to_camera(world)
    J, by_point = camera.project_jacobian(points)
    return without_pose(J.reshape(-1, J.shape[2]), (by_point @ by_motion(points)).reshape(-1, 6))


def without_pose(J: Array, P: Array) -> Array:
    """(f, f) information of rows of derivatives (n, f), with a pose (n, 6) eliminated."""
    C = J.T @ P
    return np.asarray(J.T @ J - C @ np.linalg.pinv(P.T @ P, hermitian=True) @ C.T)


def pixel_changes(camera: Camera, pixels: Array, depths: Array) -> Array:
    """Derivatives (g, 2, 5 + K) of pixels by the camera, without what a motion of its frame compensates.

    The pixels (G, 2) are all over the image; those without a ray are left out. Each has a point at each of
    the depths (D,).
    """
    rays = camera.seen_points(pixels)
    rays = rays[np.isfinite(rays[:, 0])]
    points = np.concatenate([depth * rays for depth in depths])
    J, by_point = camera.project_jacobian(points)
    P = by_point @ by_motion(points)
    motion = np.linalg.lstsq(P.reshape(-1, 6), J.reshape(-1, J.shape[2]), rcond=None)[0]
    return np.asarray(J - P @ motion)
