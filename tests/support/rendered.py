"""Named scenes for tests of detection: ``condition(name, seed)`` and ``picture(name, seed)``.

The base condition is 640 x 480 pixels, 10 x 7 squares (9 x 6 inner vertices) of about 36 px, tilt
30 degrees, blur 0.8 px, black and white 30 and 226 DN, noise 2 DN, 8 bits. Every other condition
changes what its name says. The same seed gives the same random pose in all of them that leave room
for it, so that they can be compared image by image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.observations.board import Plane
from support.clutter import KINDS, Clutter
from support.occluders import Disc, Rectangle
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

SQUARE = 28.0  # mm
PLAIN = Clutter()
EVEN = Illumination()


@dataclass(frozen=True)
class Recipe:
    """What a scene with one board is made from; lengths in px of a 640 x 480 image."""

    zoom: float = 1.0  # of the whole image
    focal: float = 800.0
    distortion: tuple[float, ...] = ()
    theta: float = np.pi / 2
    cols: int = 9
    rows: int = 6
    square: float = 36.0  # side of the middle square without tilt
    tilt: float = 30.0  # degrees
    roll: float = 20.0  # degrees, at most
    margin: float = 0.5  # white paper, in squares
    black: float = 30 / 255
    white: float = 226 / 255
    background: Clutter = PLAIN
    illumination: Illumination = EVEN
    psf: float = 0.8
    noise: float = 2.0
    response: float | Literal["srgb"] = 1.0
    gain: float = 1.0
    full_well: float | None = None
    bits: Literal[8, 16] = 8
    framing: Literal["whole", "cut"] = "whole"


def single(recipe: Recipe, rng: np.random.Generator) -> Scene:
    """A scene with one board at a random pose."""
    size = (round(640 * recipe.zoom), round(480 * recipe.zoom))
    focal = recipe.focal * recipe.zoom
    centre = (0.5 * (size[0] - 1) + 2.3 * recipe.zoom, 0.5 * (size[1] - 1) - 1.7 * recipe.zoom)
    intrinsics = Intrinsics(focal, 1.003 * focal, *centre, recipe.theta)
    camera = Camera(intrinsics, Distortion("plumb_bob", recipe.distortion), size)
    plane = Plane("", recipe.cols, recipe.rows, SQUARE)
    margin = Sides.all(recipe.margin)
    target = Target(plane, recipe.black, recipe.white, bool(rng.integers(2)), margin=margin)
    sensor = Sensor(recipe.response, recipe.gain, 0.0, recipe.noise, recipe.full_well, bits=recipe.bits)
    scene = Scene(
        camera,
        Pose(np.eye(3), np.array([0.0, 0.0, 1000.0])),
        (target,),
        replace(recipe.background, seed=int(rng.integers(2**31))),
        illumination=recipe.illumination,
        psf=recipe.psf,
        sensor=sensor,
    )
    return _posed(scene, recipe, rng)


def _posed(scene: Scene, recipe: Recipe, rng: np.random.Generator) -> Scene:
    """Try random poses until the board is in the frame as it should be."""
    width, height = scene.size
    spread = 0.5 if recipe.framing == "cut" else 0.25
    for attempt in range(2000):
        azimuth, roll = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(-recipe.roll, recipe.roll))
        shift = rng.uniform(-spread, spread, 2) * [width, height]
        if recipe.framing == "whole":
            shift *= max(0.0, 1 - attempt / 100)  # large boards only fit in the middle
        middle = np.array([0.5 * width, 0.5 * height]) + shift
        square = recipe.square * recipe.zoom * rng.uniform(0.97, 1.03)
        scene = replace(scene, pose=board_pose(scene, middle, square, recipe.tilt, azimuth, roll))
        if _framed(scene, recipe.framing):
            return scene
    raise AssertionError(f"no pose keeps the board in the frame: {recipe}")


def board_pose(scene: Scene, middle: Array, square: float, tilt: float, azimuth: float, roll: float) -> Pose:
    """Pose that shows the only board's centre at a pixel, its squares with a side [px], tilted [degrees]."""
    plane = scene.targets[0].plane
    tilted = np.radians(tilt)
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    R = np.eye(3) + np.sin(tilted) * K + (1 - np.cos(tilted)) * K @ K
    c, s = np.cos(roll), np.sin(roll)
    R = R @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    ray = scene.camera.rays(middle[:1], middle[1:])
    depth = scene.camera.intrinsics.alpha_u * plane.square / square
    centre = plane.at([(plane.cols - 1) / 2, (plane.rows - 1) / 2])
    return Pose(R, depth * np.array([ray.x[0], ray.y[0], 1.0]) - R @ centre)


def _framed(scene: Scene, framing: str) -> bool:
    truth = ground_truth(scene).planes[0]
    share = float(truth.vertices_visible.mean())
    if framing == "cut":
        return 0.5 <= share <= 0.9
    x_low, x_high, y_low, y_high = scene.targets[0].paper_box
    s = np.linspace(0, 1, 20)
    x, y = x_low + s * (x_high - x_low), y_low + s * (y_high - y_low)
    edge = np.concatenate(
        [np.stack(np.broadcast_arrays(*p), -1) for p in ((x, y_low), (x, y_high), (x_low, y), (x_high, y))]
    )
    matrix = scene.plane_to_camera(scene.targets[0])
    points = edge @ matrix[:, :2].T + matrix[:, 2]
    pixels, seen = scene.camera.project(points)[0], scene.camera.sees(points)
    inside = (pixels > 2) & (pixels < np.array(scene.size) - 3)
    return share == 1 and bool(seen.all() and inside.all())


def folded(
    rng: np.random.Generator,
    planes: int = 2,
    distortion: tuple[float, ...] = (),
    across: bool = False,
    **changes: object,
) -> Scene:
    """Planes at right angles, the pattern up to the fold, or with squares that run across it."""
    focal, square = 800.0, 28.0 if planes == 2 else 26.0
    intrinsics = Intrinsics(focal, 1.003 * focal, 321.8, 237.8)
    camera = Camera(intrinsics, Distortion("plumb_bob", distortion), (640, 480))
    gap = 0.5 if across else 1.0
    start = gap * SQUARE
    side = start if planes == 3 else SQUARE
    floor = Plane("floor", 7, 5, SQUARE, (side, start, 0.0))
    wall = Plane("wall", 7, 4, SQUARE, (side, 0.0, start), y_axis=(0.0, 0.0, 1.0))
    third = Plane("side", 5, 4, SQUARE, (0.0, start, start), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    first = bool(rng.integers(2))
    margin, x_low = Sides.all(0.5), 0.5 if planes == 2 else 0.0
    reach = Sides(gap if planes == 3 else 1.0, 1.0, gap, 1.0)
    at_fold = replace(margin, y_low=0.0, x_low=x_low)
    # The colours alternate on, or a square that is folded keeps its colour.
    other = first if across else not first
    targets = [
        Target(floor, first_black=first, reach=reach, margin=at_fold),
        Target(wall, first_black=other, reach=reach, margin=at_fold),
        Target(third, first_black=first, reach=Sides(gap, 1.0, gap, 1.0), margin=replace(at_fold, x_low=0.0)),
    ][:planes]
    towards = np.array([0.25 if planes == 2 else 1.0, 1.0, 1.0]) + rng.uniform(-0.12, 0.12, 3)
    middle = np.array([4.0 if planes == 2 else 1.7, 1.7, 1.7]) * SQUARE
    middle[1:] -= 0.5 * SQUARE * (planes == 2)
    pose = look_at(middle, towards, focal * SQUARE / square, rng.uniform(-0.15, 0.15))
    scene = Scene(camera, pose, tuple(targets))
    return replace(scene, **changes)  # type: ignore[arg-type]


def look_at(middle: Array, towards: Array, distance: float, roll: float) -> Pose:
    """Pose of a camera at a distance from a point, in a direction from it; z is up."""
    forward = -towards / np.linalg.norm(towards)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    c, s = np.cos(roll), np.sin(roll)
    R = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ np.array([right, np.cross(forward, right), forward])
    return Pose(R, np.array([0.0, 0.0, distance]) - R @ middle)


CLUTTER = Clutter(kinds=KINDS)
STRONG = Illumination(0.7, (0.75, -0.45))
FIVE_MEGAPIXELS = 4.05
MIX = Recipe(
    tilt=50,
    psf=1.5,
    noise=6,
    response=2.2,
    black=0.09,
    white=0.95,
    distortion=(-0.2, 0.05),
    focal=650,
    background=CLUTTER,
)

RECIPES: dict[str, Recipe] = {
    "base": Recipe(),
    "noise 0.5": Recipe(noise=0.5),
    "noise 5": Recipe(noise=5),
    "noise 12": Recipe(noise=12),
    "psf 0.15": Recipe(psf=0.15),
    "straight, psf 0.15": Recipe(psf=0.15, tilt=0, roll=1),  # edges along the pixels
    "psf 0.5": Recipe(psf=0.5),
    "psf 2": Recipe(psf=2),
    "psf 3": Recipe(psf=3),
    "poisson": Recipe(full_well=8000, noise=1),
    "tilt 0": Recipe(tilt=0),
    "tilt 50": Recipe(tilt=50),
    "tilt 65": Recipe(tilt=65),
    "tilt 75": Recipe(tilt=75),
    "k1 -0.3": Recipe(distortion=(-0.3, 0.08, 0.001, -0.0005), focal=600),
    "k1 -0.4 wide": Recipe(distortion=(-0.4, 0.13, 0.0, 0.0, -0.01), focal=430, square=40, tilt=25),
    "skew": Recipe(theta=np.pi / 2 - 0.02, distortion=(-0.15,)),
    "gamma 2.2": Recipe(response=2.2, black=0.09, white=0.95),
    "srgb": Recipe(response="srgb", black=0.09, white=0.95),
    "saturated": Recipe(gain=1.3),
    "16 bit": Recipe(bits=16, noise=0.2),
    "squares 16": Recipe(square=16),
    "squares 10": Recipe(square=10),
    "squares 6": Recipe(square=6),
    "illumination": Recipe(illumination=STRONG),
    "vignetting": Recipe(illumination=Illumination(1.0, (0.2, 0.1), 0.6)),
    "low contrast": Recipe(black=0.44, white=0.44 + 30 / 255),
    "narrow margin": Recipe(margin=0.15, background=Clutter(level=0.12)),
    "clutter": Recipe(background=CLUTTER),
    "mix": MIX,
    "board cut": Recipe(framing="cut", square=46),
    "2 Mpx": Recipe(zoom=2.5),
    "5 Mpx": Recipe(zoom=FIVE_MEGAPIXELS),
    "5 Mpx clutter": Recipe(zoom=FIVE_MEGAPIXELS, noise=4, background=CLUTTER),
}


def _occluded(rng: np.random.Generator) -> Scene:
    scene = single(Recipe(), rng)
    truth = ground_truth(scene).planes[0]
    place = truth.midpoints[rng.integers(len(truth.midpoints))]
    centre = (float(place[0]), float(place[1]))
    level = float(rng.uniform(0.05, 0.9))
    if rng.integers(2):
        return replace(scene, occluders=(Disc(centre, float(rng.uniform(20, 40)), level),))
    size = (float(rng.uniform(25, 90)), float(rng.uniform(25, 60)))
    return replace(scene, occluders=(Rectangle(centre, size, float(rng.uniform(0, np.pi)), level),))


def _clutter_only(rng: np.random.Generator, zoom: float = 1.0) -> Scene:
    strewn = replace(CLUTTER, amount=int(rng.integers(15, 60)), scale=40 * zoom**0.6)
    return replace(single(Recipe(zoom=zoom, background=strewn), rng), targets=())


def _two_boards(rng: np.random.Generator) -> Scene:
    """Two boards that have nothing to do with each other, one partly before the other."""
    scene = single(Recipe(cols=8, rows=6, square=24, tilt=20), rng)
    back = replace(scene.targets[0], plane=replace(scene.targets[0].plane, name="back"))
    nearer = (SQUARE * 6.5, SQUARE * 3.6, -60.0)
    tilted = float(np.cos(0.4)), 0.0, float(np.sin(0.4))
    front = Target(Plane("front", 6, 5, 0.6 * SQUARE, nearer, tilted))
    return replace(scene, targets=(back, front))


def stress(rng: np.random.Generator, hard: bool) -> Scene:
    """A random mixture of everything, fully visible."""
    rng.random(3 if hard else 0)  # other scenes than the easier ones of the same seed
    tilt, noise, psf = (70, 10, 3.0) if hard else (60, 8, 2.0)
    contrast = rng.uniform(0.25 if hard else 0.3, 0.8)
    black = rng.uniform(0.04, 0.9 - contrast)
    wide = rng.uniform() < 0.4
    recipe = Recipe(
        focal=620 if wide else float(rng.uniform(700, 1200)),
        distortion=(float(rng.uniform(-0.28, -0.1)), 0.05) if wide else (float(rng.uniform(-0.1, 0.05)),),
        cols=int(rng.integers(5, 12)),
        rows=int(rng.integers(4, 8)),
        square=float(rng.uniform(9 if hard else 16, 32)),
        tilt=float(rng.uniform(0, tilt)),
        roll=180.0,
        margin=float(rng.uniform(0.15 if hard else 0.4, 1.0)),
        black=float(black),
        white=float(black + contrast),
        background=CLUTTER if rng.uniform() < 0.6 else Clutter(level=float(rng.uniform(0.05, 0.95))),
        illumination=Illumination(
            float(rng.uniform(0.6, 1.0)),
            (float(rng.uniform(-0.8, 0.8)), float(rng.uniform(-0.6, 0.6))),
            float(rng.uniform(0, 0.4)),
        ),
        psf=float(rng.uniform(0.5, psf)),
        noise=float(rng.uniform(0.5, noise)),
        response=2.2 if rng.uniform() < 0.5 else 1.0,
    )
    return single(recipe, rng)


BARREL = (-0.25, 0.06, 0.0005, 0.0005)

OTHERS: dict[str, Callable[[np.random.Generator], Scene]] = {
    "occluded": _occluded,
    "two planes": folded,
    "two planes distorted": lambda rng: folded(rng, distortion=BARREL),
    "two planes across": lambda rng: folded(rng, across=True),
    "three planes": lambda rng: folded(rng, planes=3),
    "three planes across": lambda rng: folded(rng, planes=3, across=True),
    "two boards": _two_boards,
    "clutter only": _clutter_only,
    "clutter only 5 Mpx": lambda rng: _clutter_only(rng, FIVE_MEGAPIXELS),
    "stress 1": lambda rng: stress(rng, hard=False),
    "stress 2": lambda rng: stress(rng, hard=True),
}

CONDITIONS: tuple[str, ...] = (*RECIPES, *OTHERS)


def condition(name: str, seed: int) -> Scene:
    """The scene of a condition; another seed gives another pose."""
    rng = np.random.default_rng(seed)
    return single(RECIPES[name], rng) if name in RECIPES else OTHERS[name](rng)


def rendered(scene: Scene, rng: np.random.Generator, parts: int = 4) -> Rendered:
    """As by `render`, in half of the time: with fewer cells, edges are right to 0.001 px (of 6: 0.0003)."""
    return Rendered(digitised(scene.sensor, image_light(scene, parts), rng), ground_truth(scene))


@lru_cache(32)
def picture(name: str, seed: int) -> Rendered:
    """The picture of a condition, its noise decided by the seed as well."""
    return rendered(condition(name, seed), np.random.default_rng([seed, 1]))
