"""Boards before fisheyes: random poses, laws and image circles, rendered with their exact truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.observations.board import Plane
from support.clutter import KINDS, Clutter
from support.pictures import Illumination, Rendered, Scene, Sensor, Sides, Target, render
from support.wide_camera import ImageCircle, Law, WideCamera

SQUARE = 30.0  # mm


@dataclass(frozen=True)
class WideRecipe:
    """What a scene is made from."""

    field: float = 180.0  # degrees, across the image circle
    law: Law = "equidistant"
    k: tuple[float, ...] = ()
    size: tuple[int, int] = (960, 720)
    circle: float = 0.52  # radius of the image circle, in widths of the image
    cols: int = 8
    rows: int = 6
    square: float = 50.0  # px; the middle square if it were not tilted
    tilt: float = 50.0  # degrees, at most
    aside: float = 0.75  # greatest angle of the board's middle from the axis, in half fields
    framing: str = "whole"  # or "cut": partly beyond the image or its circle
    psf: float = 0.8
    noise: float = 2.0
    black: float = 30 / 255
    white: float = 226 / 255
    vignetting: float = 0.0
    ring: float = 0.0
    clutter: bool = False
    board: bool = True
    off_centre: float = 0.0  # of the image's size, by which the lens's centre lies beside the middle


def wide_scene(recipe: WideRecipe, seed: int) -> Scene:
    """A scene of a recipe; another seed gives another pose."""
    rng = np.random.default_rng([seed, 77])
    width, height = recipe.size
    radius, half = recipe.circle * width, np.radians(0.5 * recipe.field)
    plain = WideCamera(1.0, (0.0, 0.0), recipe.size, recipe.k, recipe.law, half)
    shift = rng.uniform(-recipe.off_centre, recipe.off_centre, 2) * recipe.size
    centre = (0.5 * (width - 1) + 3.3 + shift[0], 0.5 * (height - 1) - 2.7 + shift[1])
    camera = replace(plain, focal=radius / plain.radius, centre=centre)
    plane = Plane("", recipe.cols, recipe.rows, SQUARE)
    target = Target(plane, recipe.black, recipe.white, bool(rng.integers(2)), margin=Sides.all(0.5))
    strewn = Clutter(0.4, KINDS if recipe.clutter else (), seed=int(rng.integers(2**31)))
    scene = Scene(
        camera,
        Pose(np.eye(3), np.zeros(3)),
        (target,) if recipe.board else (),
        strewn,
        illumination=Illumination(),
        psf=recipe.psf,
        sensor=Sensor(read_noise=recipe.noise),
        circle=ImageCircle(centre, radius - 2, 2.0, recipe.vignetting, recipe.ring),
    )
    return _posed(scene, recipe, rng) if recipe.board else scene


def _posed(scene: Scene, recipe: WideRecipe, rng: np.random.Generator) -> Scene:
    camera = scene.camera
    assert isinstance(camera, WideCamera)
    plane = scene.targets[0].plane
    middle = plane.at([(plane.cols - 1) / 2, (plane.rows - 1) / 2])
    for attempt in range(4000):
        share = 1.0 if recipe.framing == "cut" else max(0.0, 1 - attempt / 1000)
        angle = recipe.aside * 0.5 * np.radians(recipe.field) * np.sqrt(rng.uniform()) * share
        around, roll, towards = rng.uniform(0, 2 * np.pi, 3)
        tilt = np.radians(recipe.tilt) * rng.uniform() * (1.0 if attempt < 2000 else 0.3)
        R = _turned(angle, around) @ _turned(tilt, towards) @ _about_axis(roll)
        direction = _turned(angle, around)[:, 2]
        distance = camera.focal * plane.square / (recipe.square * rng.uniform(0.9, 1.1))
        tried = replace(scene, pose=Pose(R, distance * direction - R @ middle))
        if _framed(tried, recipe.framing):
            return tried
    raise AssertionError(f"no pose keeps the board in the frame: {recipe}")


def _turned(angle: float, around: float) -> Array:
    """Rotation by an angle about an axis across z."""
    axis = np.array([-np.sin(around), np.cos(around), 0.0])
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


def _about_axis(roll: float) -> Array:
    c, s = np.cos(roll), np.sin(roll)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _framed(scene: Scene, framing: str) -> bool:
    """Whether the whole pattern, or a part of the board, is in the image and its circle."""
    target = scene.targets[0]
    x_low, x_high, y_low, y_high = target.printed.box
    a, b = np.meshgrid(np.linspace(x_low, x_high, 41), np.linspace(y_low, y_high, 41))
    matrix = scene.plane_to_camera(target)
    points = np.stack([a, b], axis=-1) @ matrix[:, :2].T + matrix[:, 2]
    # The camera must stand before the board.
    if np.linalg.det(matrix) <= 0:
        return False
    pixels, seen = scene.camera.project(points)
    assert scene.circle is not None
    room = np.hypot(*np.moveaxis(pixels - np.array(scene.circle.centre), -1, 0)) < scene.circle.radius - 6
    room &= seen & ((pixels > 3) & (pixels < np.array(scene.size) - 4)).all(axis=-1)
    if framing == "whole":
        return bool(room.all())
    inner = (a >= 0) & (a <= target.plane.cols - 1) & (b >= 0) & (b <= target.plane.rows - 1)
    return 0.5 <= float(room[inner].mean()) <= 0.9


def in_circle(scene: Scene, points: Array, room: float = 6.0) -> np.ndarray:
    """Whether points (..., 2) are inside the image circle by some px."""
    assert scene.circle is not None
    return np.hypot(*np.moveaxis(points - np.array(scene.circle.centre), -1, 0)) < scene.circle.radius - room


def wide_picture(recipe: WideRecipe, seed: int) -> tuple[Scene, Rendered]:
    """A scene and its picture."""
    scene = wide_scene(recipe, seed)
    return scene, render(scene, np.random.default_rng([seed, 78]))


def mixture(seed: int, clutter: float = 0.5) -> tuple[WideRecipe, Scene]:
    """A random mixture of lenses, boards, poses, light and noise; squares of 8 to 120 px."""
    rng = np.random.default_rng([seed, 79])
    laws: tuple[Law, ...] = ("equidistant", "equisolid", "stereographic")
    for _ in range(50):
        square = float(np.exp(rng.uniform(np.log(10), np.log(115))))
        size = (960, 720) if square < 60 else (1280, 960)
        contrast = float(rng.uniform(0.3, 0.8))
        black = float(rng.uniform(0.03, 0.95 - contrast))
        recipe = WideRecipe(
            field=float(rng.uniform(120, 220)),
            law=laws[rng.integers(3)],
            size=size,
            circle=float(rng.uniform(0.36, 0.6)),
            cols=int(rng.integers(5, 12)),
            rows=int(rng.integers(4, 9)),
            square=square,
            tilt=55.0,
            psf=float(rng.uniform(0.5, 1.8)),
            noise=float(rng.uniform(0.5, 7)),
            black=black,
            white=black + contrast,
            vignetting=float(rng.uniform(0, 0.7)),
            ring=float(rng.choice([0.0, 0.0, 0.5, 1.0])),
            clutter=bool(rng.uniform() < clutter),
            off_centre=float(rng.choice([0.0, 0.05])),
        )
        try:
            return recipe, wide_scene(recipe, int(rng.integers(2**31)))
        except AssertionError:
            continue  # a board too large for its image
    raise AssertionError(f"no scene for the seed {seed}")
