"""Flat boards seen through lenses that bend, drawn at random, none of which folds back; and new views."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.problem import normalised
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.lens_choice.monotonic_fit import where_not_monotonic
from neurocal_cli.camera.distortion import Distortion, distort
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.monotonic import is_monotonic, monotonic_radius
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.camera.rich_lens import NODES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences
from support.plain_projection import project
from support.scenes import Scene, random_flat_set

BENT = ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "fisheye")
SIGMA = 0.2
# Coefficients of real lenses' sizes.
LENSES = {
    "none": [],
    "k1": [-0.28],
    "k1k2": [-0.2286, 0.1904],
    "k1k2p1p2": [-0.26, 0.06, 2e-3, -1e-3],
    "plumb_bob": [-0.26, 0.06, 2e-3, -1e-3, 0.03],
    "rational": [0.4, -0.2, 1e-3, 2e-3, 0.05, 0.7, -0.1, 0.02],
    "thin_prism": [0.4, -0.2, 1e-3, 2e-3, 0.05, 0.7, -0.1, 0.02, 2e-3, -1e-3, -3e-3, 2e-3],
    "tilted": [0.4, -0.2, 1e-3, 2e-3, 0.05, 0.7, -0.1, 0.02, 2e-3, -1e-3, -3e-3, 2e-3, 0.006, -0.008],
    "fisheye": [0.08, -0.03, 0.02, -0.005],
    "omnidir": [0.9, -0.1, 0.03, 1e-3, -2e-3],
    "double_sphere": [-0.2, 0.58],
    "eucm": [0.6, 1.1],
    "rich": [0.08, -0.03, 0.02, -0.005, 0.5, 0.4, 0.3, *np.random.default_rng(0).normal(0, 1e-3, len(NODES))],
}


def bent_set(model: str, seed: int) -> tuple[Scene, list[float]]:
    """A scene of a bent lens and its coefficients."""
    rng = np.random.default_rng(seed)
    n_views = int(rng.integers(8, 20))
    fixed = {"f": 330.0, "width": 640} if model == "fisheye" else {}
    while True:
        scene = random_flat_set(rng, n_views, False, **fixed)
        A, (width, height) = scene.intrinsics.A, scene.image_size
        corners = np.array([[u, v] for u in (0, width) for v in (0, height)])
        reach = float(np.hypot(*((corners - A[:2, 2]) / [A[0, 0], A[1, 1]]).T).max())
        k = coefficients(model, 0.6 * width / A[0, 0], rng)
        enough = len(scene.world) >= 25 * n_views
        if not enough or (model != "none" and monotonic_radius(Distortion(model, k)) < 1.6 * reach):
            continue
        bent = through(scene, model, k)
        if (
            sees(scene, model, k).all()
            and where_not_monotonic(Distortion(model, k), A, bent.points()) is None
        ):
            return bent, k


def coefficients(model: str, r: float, rng: np.random.Generator) -> list[float]:
    """Coefficients that bend by 5 to 25 % at the radius r."""
    sign = rng.choice([-1.0, 1.0])
    k1, k2 = sign * rng.uniform(0.05, 0.25) / r**2, -sign * rng.uniform(0.02, 0.1) / r**4
    p1, p2 = rng.uniform(0.003, 0.01, 2) * rng.choice([-1, 1], 2) / r
    k3 = sign * rng.uniform(0.02, 0.06) / r**6
    whole = [k1, k2, p1, p2, k3]
    if model == "fisheye":
        return (rng.normal(size=4) * [0.05, 0.02, 0.01, 0.003]).tolist()
    return [float(k) for k in whole[: {"none": 0, "k1": 1, "k1k2": 2, "k1k2p1p2": 4, "plumb_bob": 5}[model]]]


def sees(scene: Scene, model: str, k: list[float]) -> NDArray[np.bool_]:
    """Whether the scene's points, as a pinhole has them, lie where the lens does not fold."""
    x, y = without_camera(scene.intrinsics.A, scene.pixels)
    return is_monotonic(Distortion(model, k), x, y)


def without_camera(A: Array, pixels: Array) -> tuple[Array, Array]:
    y = (pixels[:, 1] - A[1, 2]) / A[1, 1]
    return (pixels[:, 0] - A[0, 2] - A[0, 1] * y) / A[0, 0], y


@dataclass(frozen=True, eq=False)
class NewViews:
    """Views that no calibration has seen, with their true poses in the order of the views."""

    points: Correspondences
    poses: list[Pose]

    def error(self, camera: Calibration) -> float:
        """Rms error [px] of a camera in them, each through the pose that suits the camera best."""
        views, R = arrange(self.points), np.stack([pose.R for pose in self.poses])
        known, t = camera.camera, np.stack([pose.t for pose in self.poses])
        lens = known.distortion
        given = CameraState(np.array([known.entries]), R, t, lens.model, lens.coefficients)
        start = normalised(given, views)
        found = adjust(views.batches, start, np.zeros(5 + len(start.k), dtype=bool))
        return float(np.sqrt(found.cost.sum() / len(views.index))) * views.pixel_scale


def within_reach(new: NewViews, scene: Scene, points: Correspondences) -> NewViews:
    """New views without what lies farther from the axis than any of some points."""
    far, reach = (np.hypot(*without_camera(scene.intrinsics.A, p.pixels)) for p in (new.points, points))
    some = new.points.select(far <= reach.max())
    some = some.select((np.bincount(some.view_index) >= 12)[some.view_index])
    poses = dict(zip(new.points.view_names, new.poses, strict=True))
    return NewViews(some, [poses[name] for name in some.view_names])


def new_views(scene: Scene, model: str, k: list[float], seed: int, n_views: int = 20) -> NewViews:
    """Other boards anywhere in the image of the same camera, with noise."""
    rng = np.random.default_rng([seed, 2])
    K = scene.intrinsics
    others = random_flat_set(rng, n_views, False, f=K.alpha_u, width=scene.image_size[0], cols=9, rows=7)
    view = np.array(others.view)
    pixels = np.concatenate([project(K.A, others.poses[v], others.world[view == v])[0] for v in others.poses])
    pinhole = replace(others, pixels=pixels, intrinsics=K, image_size=scene.image_size)
    points = through(pinhole, model, k).points(SIGMA, rng)
    inside = ((points.pixels > 0) & (points.pixels < np.array(scene.image_size) - 1)).all(axis=1)
    points = points.select(inside & sees(pinhole, model, k))
    enough = np.bincount(points.view_index) >= 12
    points = points.select(enough[points.view_index])
    return NewViews(points, [others.poses[name] for name in points.view_names])


def through(scene: Scene, model: str, k: list[float]) -> Scene:
    """The same scene through a lens."""
    if model == "none":
        return scene
    A = scene.intrinsics.A
    x, y = without_camera(A, scene.pixels)
    x, y = distort(model, k, x, y)
    return replace(
        scene, pixels=np.column_stack([A[0, 0] * x + A[0, 1] * y + A[0, 2], A[1, 1] * y + A[1, 2]])
    )
