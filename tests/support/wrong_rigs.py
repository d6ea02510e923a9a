"""Two cameras' data that are wrong in the ways such data go wrong; no rig of them may end quietly as good.

Each entry spoils a good scene, 640 x 480 px with 0.15 px of noise: twelve pairs of a flat board, one pair of
a folded target, or 24 pairs of a board that moves slowly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli import Calibration, Correspondences, Intrinsics, Pose, calibrate
from neurocal_cli.calibration.rig.fit import fit_rig
from neurocal_cli.calibration.rig.rig import StereoRig
from neurocal_cli.calibration.target_choice import on_one_target
from neurocal_cli.camera.geometry import Array, rotation_step, rotation_vector
from neurocal_cli.errors import NeurocalError
from support.rigs import RigScene, corner, random_rig

SIGMA = 0.15
Points = tuple[Correspondences, Correspondences]


@dataclass(frozen=True)
class Outcome:
    """What becomes of a wrong rig: "refused", "good", "usable" or "poor", its reasons, and the rig."""

    word: str
    reasons: tuple[str, ...]
    rig: StereoRig | None = None


def scene(n_pairs: int = 12, seed: int = 6) -> RigScene:
    found = random_rig(np.random.default_rng(seed), "verging", n_pairs)
    return replace(found, names=("left{}", "right{}"), ids=tuple(f"p{k}" for k in range(len(found.world))))


def folded() -> RigScene:
    return random_rig(np.random.default_rng(3), "verging", 1, target=corner())


def seen(given: RigScene, sigma: float = SIGMA, seed: int = 1) -> Points:
    rng = np.random.default_rng(seed)
    return given.points(0, sigma, rng), given.points(1, sigma, rng)


def in_parts(first: RigScene, second: RigScene, at: int, right_only: bool = True) -> Points:
    """The second scene from pair number `at` on, in the right camera or in both."""
    sides = []
    for side, (a, b) in enumerate(zip(seen(first), seen(second), strict=True)):
        late = (a.view_index >= at) & (side == 1 or not right_only)
        sides.append(replace(a, pixels=np.where(late[:, None], b.pixels, a.pixels)))
    return sides[0], sides[1]


def turned(given: RigScene, degrees: float, shift: float = 0.0) -> RigScene:
    """The same with the right camera turned about its vertical axis, and shifted to the side."""
    R = rotation_step(np.array([0.0, np.radians(degrees), 0.0])) @ given.rig.R
    return replace(given, rig=Pose(R, given.rig.t + np.array([shift, 0.0, 0.0])))


def zoomed(given: RigScene, side: int, factor: float) -> RigScene:
    cameras = list(given.cameras)
    one = cameras[side]
    cameras[side] = Intrinsics(one.alpha_u * factor, one.alpha_v * factor, one.u0, one.v0)
    return replace(given, cameras=(cameras[0], cameras[1]))


def enlarged(given: RigScene, factor: float) -> RigScene:
    """The same with a larger target, whose points have the coordinates of the first one."""
    return replace(given, world=given.world * factor)


def of_targets_moved(given: RigScene, step: Callable[[str, Pose], Pose]) -> Points:
    """The right images show each target where it is after a step."""
    later = replace(given, poses={name: step(name, pose) for name, pose in given.poses.items()})
    return seen(given)[0], seen(later)[1]


def jolted(given: RigScene, size: float, seed: int = 5) -> Points:
    rng = np.random.default_rng(seed)

    def step(_: str, pose: Pose) -> Pose:
        turn = rotation_step(rng.normal(0, 0.001 * size, 3))
        return Pose(turn @ pose.R, pose.t + rng.normal(0, size / np.sqrt(3), 3))

    return of_targets_moved(given, step)


def moving() -> RigScene:
    """A board that turns and moves by about 30 degrees and a tenth of its distance from pair to pair."""
    given = scene(24)
    middle, distance = given.world.mean(axis=0), np.median([pose.t[2] for pose in given.poses.values()])
    poses = {}
    for k, name in enumerate(given.poses):
        side = 2 * np.pi * k / 12
        R = rotation_step(np.array([np.cos(side), np.sin(side), 0.1 * np.sin(1.7 * side)]) * 0.5)
        centre = np.array([0.1 * np.sin(0.7 * side), 0.08 * np.cos(side), 1.0 + 0.1 * np.sin(1.3 * side)])
        poses[name] = Pose(R, distance * centre - R @ middle)
    return replace(given, poses=poses)


def on_the_way(given: RigScene, share: float) -> Points:
    """Right images taken a share of the time to the next pair later; earlier if it is negative."""
    middle = given.world.mean(axis=0)
    names = list(given.poses)

    def step(name: str, pose: Pose) -> Pose:
        neighbour = names.index(name) + (1 if share > 0 else -1)
        if not 0 <= neighbour < len(names):
            return pose
        there = given.poses[names[neighbour]]
        R = rotation_step(abs(share) * rotation_vector(there.R @ pose.R.T)) @ pose.R
        here, goal = (one.R @ middle + one.t for one in (pose, there))
        return Pose(R, here + abs(share) * (goal - here) - R @ middle)

    return of_targets_moved(given, step)


def loose(given: RigScene, degrees: float) -> Points:
    """The right camera turns a little from pair to pair."""
    rng = np.random.default_rng(6)
    left, right = seen(given)
    pixels = np.array(right.pixels)
    for k in range(right.n_views):
        rows = right.view_index == k
        pixels[rows] = seen(turned(given, float(rng.normal(0, degrees))))[1].pixels[rows]
    return left, replace(right, pixels=pixels)


def with_views(points: Correspondences, order: Array, rows: Array) -> Correspondences:
    """The pixels of view number order[k] under the name of view k, and within views of other points."""
    pixels = points.pixels.reshape(points.n_views, -1, 2)
    return replace(points, pixels=pixels[order][:, rows].reshape(-1, 2))


def exchanged(points: Points, which: list[int]) -> Points:
    rows = np.isin(points[0].view_index, which)[:, None]
    a, b = (side.pixels for side in points)
    return replace(points[0], pixels=np.where(rows, b, a)), replace(points[1], pixels=np.where(rows, a, b))


def right_rows(points: Points, order: Array, rows: Array) -> Points:
    return points[0], with_views(points[1], order, rows)


def with_right_pixels(points: Points, change: Callable[[Array], Array]) -> Points:
    return points[0], replace(points[1], pixels=change(points[1].pixels))


def one_image_lost(points: Points, after: int) -> Points:
    """Without the right image number `after`, so that all later ones have the names of their neighbours."""
    order = np.arange(12)
    order[after:-1] += 1
    right = with_views(points[1], order, SAME)
    return points[0].select(points[0].view_index < 11), right.select(right.view_index < 11)


def half_turned(points: Points, which: list[int]) -> Points:
    turned_right = with_views(points[1], ALL, BACKWARDS).pixels
    rows = np.isin(points[1].view_index, which)[:, None]
    return points[0], replace(points[1], pixels=np.where(rows, turned_right, points[1].pixels))


def in_units(points: Points, sides: tuple[int, ...], which: range, factor: Array | float) -> Points:
    out = list(points)
    for side in sides:
        rows = np.isin(points[side].view_index, list(which))
        world = np.where(rows[:, None], points[side].world * factor, points[side].world)
        out[side] = replace(points[side], world=world)
    return out[0], out[1]


def without_ids(points: Points) -> Points:
    return replace(points[0], point=None), replace(points[1], point=None)


ALL = np.arange(12)
SAME, BACKWARDS = np.arange(54), np.arange(54)[::-1]
UPSIDE_DOWN = SAME.reshape(6, 9)[::-1].ravel()
Spoiler = Callable[[], Points]

# What is wrong, how to make it, and what one of the reasons must say.
WRONG: dict[str, tuple[Spoiler, str]] = {
    "right images late while the target moves by 2 mm": (
        lambda: jolted(scene(), 2.0), "not taken at the same moment"),
    "right images late while the target moves by 0.5 mm": (
        lambda: jolted(scene(), 0.5), "not taken at the same moment"),
    "right images late by 10 % of the time to the next pair": (
        lambda: on_the_way(moving(), 0.1), "taken later by 0.1|taken later by 0.09"),
    "right images early by 10 % of the time to the next pair": (
        lambda: on_the_way(moving(), -0.1), "taken earlier by 0.1|taken earlier by 0.09"),
    "right images of the next pair": (
        lambda: right_rows(seen(scene()), np.roll(ALL, -1), SAME), "camera right of the previous frame"),
    "right images of the previous pair": (
        lambda: right_rows(seen(scene()), np.roll(ALL, 1), SAME), "camera right of the next frame"),
    "one right image missing after six pairs": (
        lambda: one_image_lost(seen(scene()), 6), "left image fits the right one of the previous"),
    "one right image missing after three pairs": (
        lambda: one_image_lost(seen(scene()), 3), "left image fits the right one of the previous"),
    "one pair of different moments": (
        lambda: in_parts(scene(), turned(scene(), 0.0, 3.0), 11), "left12/right12: .*same moment"),
    "rig bumped by 0.1 degrees half way": (
        lambda: in_parts(scene(), turned(scene(), 0.1), 6), "moved between left06/right06"),
    "rig bumped by 0.5 degrees and 1 mm half way": (
        lambda: in_parts(scene(), turned(scene(), 0.5, 1.0), 6), "moved between left06/right06"),
    "rig bumped by 0.5 degrees after four pairs": (
        lambda: in_parts(scene(), turned(scene(), 0.5), 4), "moved between left04/right04"),
    "rig knocked by 5 degrees after eight pairs": (
        lambda: in_parts(scene(), turned(scene(), 5.0), 8), "moved between left08/right08"),
    "squares of another board, 0.3 % larger, half way": (
        lambda: in_parts(scene(), enlarged(scene(), 1.003), 6, right_only=False),
        "size of the target changed between left06.*: it is 0.[23][0-9]? % larger than before"),
    "squares of another board, 2 % larger, after four pairs": (
        lambda: in_parts(scene(), enlarged(scene(), 1.02), 4, right_only=False),
        "size of the target changed between left04.*: it is 2 % larger than before"),
    "right camera loose by 0.1 degrees": (
        lambda: loose(scene(), 0.1), "not fixed to each other"),
    "right camera refocused by 0.7 % half way": (
        lambda: in_parts(scene(), zoomed(scene(), 1, 1.007), 6), "focal length of the right"),
    "left camera zoomed by 2 % after eight pairs": (
        lambda: in_parts(scene(), zoomed(scene(), 0, 1.02), 8, right_only=False),
        "focal length of the left"),
    "both cameras refocused by 2 % half way": (
        lambda: in_parts(scene(), zoomed(zoomed(scene(), 0, 1.02), 1, 1.02), 6, right_only=False),
        "focal lengths of all cameras changed by .2"),
    "left camera zoomed by 10 % half way": (
        lambda: in_parts(scene(), zoomed(scene(), 0, 1.1), 6, right_only=False), "zoom or focus"),
    "images of one pair exchanged": (
        lambda: exchanged(seen(scene()), [3]), "left04/right04: the left and the right image are exchanged"),
    "images of every other pair exchanged": (
        lambda: exchanged(seen(scene()), [1, 3, 5, 7, 9, 11]), "exchanged"),
    "images exchanged from the seventh pair on": (
        lambda: exchanged(seen(scene()), list(range(6, 12))), "exchanged between left06 and left07"),
    "board turned round in one right image": (
        lambda: half_turned(seen(scene()), [5]), "left06/right06: the target is turned by 180"),
    "board turned round in every right image": (
        lambda: half_turned(seen(scene()), list(range(12))), "turned by 180 degrees"),
    "right images mirrored": (
        lambda: with_right_pixels(seen(scene()), lambda pixels: [639, 0] + pixels * [-1, 1]), "mirrored"),
    "right images mirrored, and their points numbered as in a true image": (
        lambda: right_rows(
            with_right_pixels(seen(scene()), lambda pixels: [639, 0] + pixels * [-1, 1]), ALL, UPSIDE_DOWN
        ), "mirrored"),
    "u and v swapped in the right images": (
        lambda: with_right_pixels(seen(scene()), lambda pixels: pixels[:, ::-1]), "u and v are exchanged"),
    "right views in another order": (
        lambda: right_rows(seen(scene()), np.random.default_rng(2).permutation(12), SAME), "contradict"),
    "right points in inches": (
        lambda: in_units(without_ids(seen(scene())), (1,), range(12), 1 / 25.4), "coordinates and unit"),
    "right points in inches, with ids": (
        lambda: in_units(seen(scene()), (1,), range(12), 1 / 25.4), "one unit"),
    "half of the pairs in inches": (
        lambda: in_units(seen(scene()), (0, 1), range(6), 1 / 25.4), "times as large"),
    "right board mirrored": (
        lambda: in_units(seen(scene()), (1,), range(12), np.array([-1.0, 1.0, 1.0])), "one board"),
    "one camera twice": (
        lambda: (seen(scene())[0], replace(seen(scene(), seed=2)[0], view=seen(scene())[1].view)),
        "same place"),
    "one pair of different moments, and no other": (
        lambda: of_targets_moved(folded(), lambda _, pose: Pose(pose.R, pose.t + np.array([0.0, 4.0, 0.0]))),
        "one pair"),
    "two pairs, the rig bumped between them": (
        lambda: in_parts(scene(2), turned(scene(2), 0.5), 1), "not fixed to each other"),
}  # fmt: skip


# Those whose cause others show as well.
SLOW = frozenset(
    {
        "board turned round in every right image",
        "images of one pair exchanged",
        "one pair of different moments, and no other",
        "right views in another order",
        "board turned round in one right image",
        "both cameras refocused by 2 % half way",
        "left camera zoomed by 2 % after eight pairs",
        "one pair of different moments",
        "rig bumped by 0.5 degrees and 1 mm half way",
        "right camera refocused by 0.7 % half way",
        "right images of the next pair",
        "right points in inches",
        "squares of another board, 0.3 % larger, half way",
        "squares of another board, 2 % larger, after four pairs",
        "half of the pairs in inches",
        "images of every other pair exchanged",
        "one right image missing after three pairs",
        "right images early by 10 % of the time to the next pair",
        "right images late while the target moves by 0.5 mm",
        "right images mirrored, and their points numbered as in a true image",
        "right images of the previous pair",
        "rig bumped by 0.1 degrees half way",
        "rig bumped by 0.5 degrees after four pairs",
        "rig knocked by 5 degrees after eight pairs",
        "u and v swapped in the right images",
    }
)


def outcome(name: str) -> Outcome:
    """What becomes of a wrong rig."""
    spoil, _ = WRONG[name]
    return judged(spoil())


def judged(points: Points) -> Outcome:
    """Calibrate two cameras and their rig, and judge it."""
    try:
        left, right = (_alone(side) for side in points)
        sides = dict(zip(("left", "right"), on_one_target(left, right), strict=True))
        rig = fit_rig(sides, refine_cameras=True).pair("left", "right")
    except NeurocalError as error:
        return Outcome("refused", (str(error),))
    verdict = rig.verdict
    assert verdict is not None
    return Outcome(verdict.word, verdict.reasons, rig)


def _alone(points: Correspondences) -> Calibration:
    return calibrate(points, distortion="none", skew=False)
