"""Rendered pictures of boards with markers, tags and circles, with their truth."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.detection.detect import Detection
from neurocal_cli.files.board_kinds import short_board
from neurocal_cli.observations.board import Plane
from neurocal_cli.observations.board_kinds import CirclePlane, TagPlane
from support.pictures import (
    Illumination,
    Rendered,
    Scene,
    Sensor,
    Sides,
    Target,
    digitised,
    ground_truth,
    image_light,
)

EVEN = Illumination()


def plane_of(form: str, legacy: bool = False) -> Plane:
    """Plane of a board in short."""
    board = short_board(form)
    assert board is not None
    plane = board.planes[0]
    if not legacy:
        return plane
    assert plane.markers is not None
    return replace(plane, markers=replace(plane.markers, legacy=True))


def marked_scene(
    plane: Plane,
    seed: int,
    square: float = 40.0,
    size: tuple[int, int] = (320, 240),
    tilt: float = 30.0,
    psf: float = 0.8,
    noise: float = 2.0,
    k1: float = 0.0,
    illumination: Illumination = EVEN,
    shift: tuple[float, float] = (0.0, 0.0),
) -> Scene:
    """A board at a random pose, its middle at a `shift` [px] from that of the image."""
    rng = np.random.default_rng([seed, 44])
    focal = 1.25 * size[0]
    intrinsics = Intrinsics(focal, 1.003 * focal, 0.5 * (size[0] - 1) + 1.3, 0.5 * (size[1] - 1) - 1.7)
    camera = Camera(intrinsics, Distortion("plumb_bob", (k1,) if k1 else ()), size)
    legacy = plane.markers is not None and bool(plane.markers.legacy)
    target = Target(plane, first_black=not legacy)
    scene = Scene(camera, Pose(np.eye(3), np.array([0.0, 0.0, 1000.0])), (target,), psf=psf)
    scene = replace(scene, sensor=Sensor(read_noise=noise), illumination=illumination)
    middle = 0.5 * plane.square * plane.spread(np.array([[plane.cols - 1.0, plane.rows - 1.0]]))[0]
    depth = focal * plane.square / square
    for _ in range(200):
        R = _rotation(rng, tilt)
        if isinstance(plane, TagPlane) and not plane.downwards:
            R = R @ np.diag([1.0, -1.0, -1.0])  # y upwards
        place = np.array([shift[0] / focal, shift[1] / focal, 1.0]) * depth
        scene = replace(scene, pose=Pose(R, place - R @ np.array([*middle, 0.0])))
        if any(shift) or ground_truth(scene, 8.0).planes[0].vertices_visible.all():
            return scene
    raise AssertionError("no pose keeps the board in the frame")


def _rotation(rng: np.random.Generator, tilt: float) -> Array:
    azimuth, roll, t = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(-15, 15)), np.radians(tilt)
    x, y = np.cos(azimuth), np.sin(azimuth)
    K = np.array([[0, 0, y], [0, 0, -x], [-y, x, 0]])
    c, s = np.cos(roll), np.sin(roll)
    turned = np.eye(3) + np.sin(t) * K + (1 - np.cos(t)) * K @ K
    return np.asarray(turned @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]))


@lru_cache(8)
def taken(scene: Scene, seed: int, parts: int = 5) -> Rendered:
    """A picture of a scene; fewer `parts` are faster and less exact."""
    rng = np.random.default_rng([seed, 45])
    return Rendered(digitised(scene.sensor, image_light(scene, parts), rng), ground_truth(scene))


def ringed(scene: Scene, hole: float, seed: int) -> Rendered:
    """A picture of a grid of circles whose middles are light up to a share of the radius, the `hole`."""
    (target,) = scene.targets
    plane = target.plane
    assert isinstance(plane, CirclePlane)

    def light(share: float) -> Array:
        # The paper stays the same.
        margin = Sides.all(target.margin.x_low + 0.5 * (1 - share) * plane.diameter / plane.square)
        discs = replace(target, plane=replace(plane, diameter=share * plane.diameter), margin=margin)
        return image_light(replace(scene, targets=(discs,)), 5)

    rings = light(1.0) - light(hole) + light(1e-3)
    return Rendered(digitised(scene.sensor, rings, np.random.default_rng([seed, 45])), ground_truth(scene))


def truth_of(picture: Rendered) -> tuple[dict[str, Array], set[str]]:
    """Positions of all points by their ids, and the ids of the visible ones."""
    (plane,) = picture.truth.planes
    ids = (*plane.vertex_ids, *plane.midpoint_ids)
    places = np.concatenate([plane.vertices.reshape(-1, 2), plane.midpoints])
    seen = np.concatenate([plane.vertices_visible.ravel(), plane.edges_visible])
    return dict(zip(ids, places, strict=True)), {name for name, one in zip(ids, seen, strict=True) if one}


def errors_of(found: Detection, picture: Rendered) -> tuple[Array, Array]:
    """Errors (N, 2) [px] of the visible points, and their squares over the covariance (N,), 1 on average."""
    places, visible = truth_of(picture)
    seen = np.array([name in visible for name in found.ids])
    error = (found.pixels - np.array([places[name] for name in found.ids]))[seen]
    suu, suv, svv = found.covariance[seen].T
    u, v = error.T
    return error, (svv * u * u - 2 * suv * u * v + suu * v * v) / (suu * svv - suv**2) / 2
