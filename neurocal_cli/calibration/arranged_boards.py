"""Whether several boards in one image are fixed to each other, and how they stand then.

Each board in an image has a pose of its own. Two boards in one image give the pose of one relative to the
other. If most images agree on it, the boards may be one target, of which each board is a plane, and a common
fit tells whether they are: then it leaves no more than the fit with a pose for each board.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.verdict.findings import name_some
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, nearest_rotation
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import NeurocalError, plural
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.separate_boards import boards_of, in_one_space, on_arrangement
from neurocal_cli.observations.target import Target, TargetChoice

# Two images agree if they place a board within this share of its size, or within so many standard deviations
# of a pixel, as in the consensus of rigs; fewest images that must agree, and their share.
_SHARE, _SIGMAS, _FEWEST, _LEAST_AGREED = 0.1, 30.0, 3, 0.5
_MOST_HYPOTHESES = 40
# Ratio of the noise with fixed boards to that with a pose for each board, above which they are loose.
_LOOSE = 1.05

Points = Mapping[str, Correspondences]
Found = TypeVar("Found")
_Pair = tuple[str, str]


def arranged(
    points: Points,
    target: TargetChoice | Target,
    fitted: Callable[[Points, TargetChoice | Target], Found],
    cameras: Callable[[Found], Mapping[str, Calibration]],
) -> tuple[Found, tuple[str, ...]]:
    """Fit cameras to images of several boards, as one target where boards are fixed to each other.

    Parameters
    ----------
    points : dict of Correspondences by the name of the camera
        With images (`Correspondences.image`).
    target : {"auto", "given", "flat", "free"} or Target
        As in `calibrate`. How boards stand to each other is estimated unless the target is given.
    fitted : callable
        Fits the cameras to points by the name of the camera, with such a target.
    cameras : callable
        The cameras of such a fit, by name.

    Returns
    -------
    found
        What `fitted` made of the points.
    told : tuple of str
        What the boards are to each other.
    """
    apart, shifts = in_one_space(points)
    alone = {name: replace(one, image=None) for name, one in apart.items()}
    free = fitted(alone, target)
    boards = dict.fromkeys(board for one in points.values() for board in boards_of(one).tolist())
    found = _arrangement(apart, cameras(free), list(boards))
    moved = {
        name: f"{shift[0]:.9g} is added to X of board {name}, also in its poses: no two boards have one place"
        for name, shift in shifts.items()
        if shift[0]
    }
    if len(found.poses) < 2:
        return free, tuple(moved.values())
    told = f"boards {name_some(found.poses)}"
    joined = on_arrangement(apart, {name: (pose.R, pose.t) for name, pose in found.poses.items()})
    try:
        as_one = {name: replace(one, image=None) for name, one in joined.items()}
        fixed = fitted(as_one, "free" if target == "auto" else target)
    except NeurocalError:
        return free, tuple(moved.values())
    ratio = _noise(cameras(fixed)) / _noise(cameras(free))
    if ratio > _LOOSE:
        return free, (
            f"{told} are not quite fixed to each other: the error is {ratio:.3g} times as large if they are; "
            "each has poses of its own",
            *moved.values(),
        )
    first = next(iter(found.poses))
    return fixed, (
        f"{told} are fixed to each other, as {plural(found.agreed, 'image')} show; X, Y, Z are those of "
        f"board {first}",
        *(text for name, text in moved.items() if name not in found.poses),
    )


def _noise(cameras: Mapping[str, Calibration]) -> float:
    """Standard deviation of a pixel over all cameras, in units of which their ratios are of interest only."""
    squares = sum(len(camera.points) * camera.rmse_px**2 for camera in cameras.values())
    unknowns = sum(6 * len(camera.views) for camera in cameras.values())
    equations = sum(2 * len(camera.points) for camera in cameras.values())
    return float(np.sqrt(max(squares, 1e-300) / max(equations - unknowns, 1)))


@frozen_dataclass(eq=False)
class _Arrangement:
    """Boards that are fixed to each other, by their poses ``X_first = R X + t``."""

    poses: Mapping[str, Pose]
    agreed: int  # number of images that show it


def _arrangement(points: Points, cameras: Mapping[str, Calibration], boards: list[str]) -> _Arrangement:
    """The largest group of boards that may be fixed to each other, from the first of them on."""
    links: dict[_Pair, tuple[Pose, int]] = {}
    for i, a in enumerate(boards):
        for b in boards[i + 1 :]:
            pose, agreed, seen = _relation(points, cameras, (a, b))
            if agreed >= max(_FEWEST, _LEAST_AGREED * seen):
                links[a, b] = pose, agreed
                links[b, a] = pose.inverse, agreed
    best = _Arrangement({}, 0)
    for first in boards:
        poses, agreed = {first: Pose(np.eye(3), np.zeros(3))}, 0
        while open_ends := [
            (links[pair][1], pair) for pair in links if pair[0] in poses and pair[1] not in poses
        ]:
            count, (a, b) = max(open_ends)
            poses[b] = poses[a].after(links[a, b][0])
            agreed += count
        if len(poses) > len(best.poses):
            best = _Arrangement(poses, agreed)
    return best


def _relation(points: Points, cameras: Mapping[str, Calibration], pair: _Pair) -> tuple[Pose, int, int]:
    """The pose ``X_a = R X_b + t`` on which most images agree, their number, and the number of all."""
    images: list[tuple[Calibration, Pose, Pose]] = []
    for name, camera in cameras.items():
        for image in dict.fromkeys(np.asarray(points[name].image).astype(str).tolist()):
            views = [camera.views.get(f"{image}:{board}") for board in pair]
            if views[0] is not None and views[1] is not None:
                images.append((camera, views[0].pose, views[1].pose))
    if not images:
        return Pose(np.eye(3), np.zeros(3)), 0, 0
    spread = _spread(points, pair[1])
    R = np.array([a.R.T @ b.R for _, a, b in images])
    t = np.array([a.R.T @ (b.t - a.t) for _, a, b in images])
    some = np.unique(np.linspace(0, len(images) - 1, min(len(images), _MOST_HYPOTHESES)).astype(int))
    agree = np.array([_agree(images, spread, R[k], t[k]) for k in some])
    fine = agree[int(np.argmax(agree.sum(axis=1)))]
    mean = nearest_rotation(R[fine].sum(axis=0))
    middle = spread[0]
    place = (R[fine] @ middle + t[fine]).mean(axis=0)
    return Pose(mean, place - mean @ middle), int(fine.sum()), len(images)


def _spread(points: Points, board: str) -> Array:
    """(5, 3) the middle of a board, and points on its two longest axes, one rms extent from it."""
    world = np.concatenate([one.world[boards_of(one) == board] for one in points.values()])
    middle = world.mean(axis=0)
    axes = np.linalg.svd(world - middle, full_matrices=False)
    steps = axes[2][:2] * (axes[1][:2, None] / np.sqrt(len(world)))
    return np.concatenate([middle[None], middle + steps, middle - steps])


def _agree(
    images: list[tuple[Calibration, Pose, Pose]], spread: Array, R: Array, t: Array
) -> NDArray[np.bool_]:
    """Which images see the second board near where the first one and a relative pose predict it."""
    found = []
    for camera, a, b in images:
        seen = camera.camera.project(b.to_camera(spread))[0]
        guess = camera.camera.project(a.to_camera(spread @ R.T + t))[0]
        size = np.sqrt(((seen - seen[0]) ** 2).sum(axis=1).mean())
        apart = np.sqrt(((seen - guess) ** 2).sum(axis=1).mean())
        found.append(bool(apart < max(_SHARE * size, _SIGMAS * camera.rmse_px)))  # False for nan
    return np.array(found)
