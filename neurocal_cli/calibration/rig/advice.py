"""Choose the views that tie the weakest pairs of cameras of a rig, one after the other.

The covariance of the relative pose of two cameras gives the standard deviation of where the one sees what the
other sees, at the distance of the boards so far. The pair that knows it least, over that distance, is the
weakest. Of the views that show the whole target to the one camera and most of it to the other, that one is
chosen after which this standard deviation is smallest. It needs no observed pixels: a view adds the normal
matrix of both cameras and their poses, with the pose of the target eliminated.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.advice import (
    Candidate,
    candidates,
    points_of_target,
    refuse_count,
    without_pose,
)
from neurocal_cli.calibration.rig.adjust import RigFit
from neurocal_cli.calibration.rig.covariance import covariance_by_points
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.space_uncertainty import fitted, has_points, pixel_moves, steps_between
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, by_motion, median
from neurocal_cli.errors import InputError

_MOST = 0.5  # least share of the target's points that the second camera has to see
_FACING = 0.2  # least cosine between the normal of a flat target and the line of sight of the second camera
_FLAT = 1e-6  # greatest ratio of thickness to size of a flat target


@frozen_dataclass(eq=False)
class TyingView:
    """A view that ties two cameras."""

    cameras: tuple[str, str]
    view: Candidate  # in the image of the first of them
    before: float  # standard deviation of where the second sees what the first sees [world unit]
    after: float  # the same with this view


@frozen_dataclass(eq=False)
class RigAdvice:
    """Views to take next, in this order."""

    views: tuple[TyingView, ...]
    unit: str
    share: float  # standard deviation of the weakest pair so far, over the distance of the boards


def advise_rig(rig: Rig, count: int = 3) -> RigAdvice:
    """Choose views greedily, each for the pair of cameras that is the weakest then.

    Raises
    ------
    InputError
        The rig has no points, a camera has no image size, no view shows the target to two cameras, or the
        number of views is not 1 to 1000.
    """
    refuse_count(count)
    if not has_points(rig):
        raise InputError("the rig holds no points; give a file that was not written with --lean")
    if any(camera.image_size is None for camera in rig.cameras.values()):
        raise InputError("the size of the images is unknown; calibrate with --image-size W H")
    fit = fitted(rig)
    names, covariance = list(rig.cameras), covariance_by_points(fit).shared
    pairs = [_Pair(rig, fit, names.index(a), names.index(b)) for a, b in rig.edges]
    views: list[TyingView] = []
    weakest = max(pairs, key=lambda pair: pair.share(covariance))
    share = weakest.share(covariance)
    for _ in range(count):
        for pair in sorted(pairs, key=lambda pair: -pair.share(covariance)):
            if pair.views:
                break
        else:
            raise InputError("no view shows the whole target to one camera and most of it to another")
        own = covariance[np.ix_(pair.columns, pair.columns)]
        gains = [_gain(own, information) for information in pair.informations]
        after = [pair.std(own - own @ gain @ own) for gain in gains]
        best = int(np.argmin(after))
        cameras = names[pair.indices[0]], names[pair.indices[1]]
        views.append(TyingView(cameras, pair.views[best], pair.std(own), after[best]))
        covariance = covariance - covariance[:, pair.columns] @ gains[best] @ covariance[pair.columns]
    return RigAdvice(tuple(views), rig.unit, share)


def _gain(covariance: Array, information: Array) -> Array:
    """By which a covariance C falls with more information, C - C G C; some unknowns may be known."""
    return np.asarray(information @ np.linalg.inv(np.eye(len(covariance)) + covariance @ information))


class _Pair:
    """Two cameras of a rig, by their index."""

    def __init__(self, rig: Rig, fit: RigFit, first: int, second: int) -> None:
        state, problem, columns = fit.state, fit.problem, fit.state.columns
        self.fit, self.indices = fit, (first, second)
        self.cameras = [list(rig.cameras.values())[side] for side in self.indices]
        self.poses = [list(rig.poses.values())[side] for side in self.indices]
        self.columns = np.concatenate(
            [part for side in self.indices for part in (columns.cameras[side], columns.rigs[side])]
        )
        self.world = points_of_target(self.cameras[0])
        seen = np.zeros(len(problem.scale), dtype=bool)
        for side in self.indices:
            seen[problem.observations[side].view] = True
        middles = (state.view_t * problem.scale[:, None])[seen & problem.together]
        self.middle = np.array([median(column) for column in middles.T])  # of the boards, in the rig
        self.distance = float(np.linalg.norm(self.poses[1].to_camera(self.middle[None])))

    @cached_property
    def views(self) -> list[Candidate]:
        """Views of the target by the first camera that the second one sees, too."""
        return [view for view in candidates(self.cameras[0]) if self._is_seen(view)]

    def share(self, covariance: Array) -> float:
        """The standard deviation over the distance of the boards, by the covariance of all unknowns."""
        return self.std(covariance[np.ix_(self.columns, self.columns)]) / self.distance

    def std(self, own: Array) -> float:
        """Largest std of where the second camera sees what the first one sees, by their own covariance."""
        first, second = self.poses
        turned = second.to_camera(self.middle[None]) - second.relative_to(first).t
        by_own = (by_motion(turned)[0] @ steps_between(self.fit, *self.indices))[:, self.columns]
        return float(np.sqrt(max(np.linalg.eigvalsh(by_own @ own @ by_own.T)[-1], 0.0)))

    @cached_property
    def informations(self) -> list[Array]:
        """Of each of the views: information on the unknowns of both cameras, without the target's pose."""
        return [self._information(view) for view in self.views]

    def _information(self, view: Candidate) -> Array:
        in_rig, rows = self._in_rig(view), []
        for which, side in enumerate(self.indices):
            points, observed = in_rig[self._shown(which, in_rig)], self.fit.problem.observations[side]
            noise = observed.views.pixel_scale / np.sqrt(observed.weight)
            by_point, by_shared = pixel_moves(self.fit, points, side)
            both = np.concatenate([by_shared[:, :, self.columns], by_point @ by_motion(points)], axis=2)
            rows.append(both.reshape(-1, both.shape[2]) / noise)
        return without_pose(*np.split(np.concatenate(rows), [len(self.columns)], axis=1)) / self.fit.variance

    def _in_rig(self, view: Candidate) -> Array:
        pose = self.poses[0]
        return np.asarray((view.pose.to_camera(self.world) - pose.t) @ pose.R)

    def _shown(self, which: int, in_rig: Array) -> NDArray[np.bool_]:
        """(N,) which points (N, 3) in the rig are in the image of the first or the second camera."""
        return self.cameras[which].camera.shows(self.poses[which].to_camera(in_rig))

    def _is_seen(self, view: Candidate) -> bool:
        in_rig = self._in_rig(view)
        if self._shown(1, in_rig).mean() < _MOST:
            return False
        _, size, axes = np.linalg.svd(in_rig - in_rig.mean(axis=0), full_matrices=False)
        if size[2] > _FLAT * size[0]:
            return True
        # Both cameras have to be on the side of a flat target that the first one sees.
        lines = [in_rig.mean(axis=0) + pose.R.T @ pose.t for pose in self.poses]
        first, second = (float(axes[2] @ line) / float(np.linalg.norm(line)) for line in lines)
        return first * second > 0 and abs(second) > _FACING
