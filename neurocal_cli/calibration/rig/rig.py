"""Cameras that are fixed to each other: a rig of any number of them, and two of them as a stereo rig.

The poses are relative to the first camera: ``X_name = R X_first + t``, of two ``X_right = R X_left + t``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from neurocal_cli.calibration.calibration import Calibration, Verdict
from neurocal_cli.calibration.presented import Presented
from neurocal_cli.calibration.rig.frames import FrameNames, pair_views, unpaired
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, cross_matrix, euler_jacobian
from neurocal_cli.camera.late_import import late
from neurocal_cli.camera.measured import PlaneErrors
from neurocal_cli.camera.pinhole import POSE_NAMES, Pose
from neurocal_cli.errors import InputError

if TYPE_CHECKING:
    from typing_extensions import Self

_LEAST_NOISE = 0.1  # of a camera's pixels over that of all; fewer points may fit better by chance


@frozen_dataclass(eq=False)
class Rig(Presented):
    """Calibrated cameras that are fixed to each other.

    Attributes
    ----------
    cameras : dict of Calibration by name
        A frame that several cameras saw has one pose: that in each camera follows from that in the first.
    poses : dict of Pose by name
        R and t, ``X_name = R X_first + t``; the first camera's is the identity.
    pose_std : dict of dict by name
        Standard deviation of R_x, R_y, R_z [rad], t_x, t_y, t_z and baseline, the distance from the first
        camera [world unit]; 0 for the first.
    covariance : (6 (C - 1), 6 (C - 1)) array
        Of the angles and translations of all cameras but the first.
    frames : dict of dict by frame
        The views that determine the rig: of each frame that several cameras saw, the view of each camera.
    views_left_out : dict of str by (camera, view)
        Views that contradict the rig, with the reason; each contributes to its own camera.
    delays : dict of (value, std) by name
        By how much the images of a camera were taken later than its stated times, or than those of the first
        camera, in seconds if the rig is `timed`, else in units of the time between frames. Empty where it is
        not estimated.
    timed : bool
        Whether the stated times of the images were used.
    rmse_px : float [px]
        ``sqrt(mean(du^2 + dv^2))`` over all points of all cameras.
    max_px : float [px]
    converged : bool
    stop_reason : str
    iterations : int
        Iterations of the common bundle adjustment.
    warnings : tuple of str
    judgement : Verdict or callable, optional
        The verdict read from a file, or the function that computes it from this rig; see `verdict`.
    """

    cameras: Mapping[str, Calibration]
    poses: Mapping[str, Pose]
    pose_std: Mapping[str, Mapping[str, float]]
    covariance: Array
    frames: Mapping[str, Mapping[str, str]]
    views_left_out: Mapping[tuple[str, str], str] = field(default_factory=dict)
    delays: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    timed: bool = field(default=False, kw_only=True)
    rmse_px: float = field(default=float("nan"), kw_only=True)
    max_px: float = field(default=float("nan"), kw_only=True)
    converged: bool = field(default=True, kw_only=True)
    stop_reason: str = field(default="", kw_only=True)
    iterations: int = field(default=0, kw_only=True)
    warnings: tuple[str, ...] = field(default=(), kw_only=True)
    judgement: Verdict | Callable[[Any], Verdict | None] | None = field(default=None, kw_only=True)

    _summary = ("commands.show.rig_report", "rig_report")

    def __repr__(self) -> str:
        return (
            f"Rig of {len(self.cameras)} cameras ({', '.join(self.cameras)}): {len(self.frames)} "
            f"frames, rms {self.rmse_px:.4g} px; see .cameras, .poses and .summary()"
        )

    @property
    def sigma(self) -> float:
        """Standard deviation of the pixels of the calibration, in u and in v [px]."""
        return self.rmse_px / float(np.sqrt(2.0))

    @cached_property
    def verdict(self) -> Verdict | None:
        """Verdict on this rig, computed when it is first read; None without points of its own."""
        found: Verdict | None = self.judgement(self) if callable(self.judgement) else self.judgement
        return found

    def errors_at(self, distance: float) -> PlaneErrors:
        """How well points and lengths are triangulated at a distance from the first camera [world unit].

        Of points that two cameras or more see, with the shares of the calibration, which is correlated
        between all points, and of the noise of the pixels. Raises InputError for a distance at which there
        are none, or that is not positive, and for a rig without points or image size.
        """
        found: PlaneErrors = late("calibration.rig.space_uncertainty", "errors_at")(self, distance)
        return found

    @property
    def lean(self) -> Self:
        """The cameras and their poses, without the data behind them."""
        return replace(
            self,
            cameras={name: camera.lean for name, camera in self.cameras.items()},
            frames={},
            views_left_out={},
            judgement=self.verdict,
        )

    @property
    def noise_shares(self) -> Array:
        """(C,) standard deviation of each camera's pixels over that of all; 1 where it is not known."""
        own = np.array([camera.sigma for camera in self.cameras.values()])
        if not (self.sigma > 0 and np.isfinite(own).all()):
            return np.ones(len(own))
        return np.asarray(np.maximum(own / self.sigma, _LEAST_NOISE))

    @property
    def first(self) -> str:
        """Name of the camera whose frame of reference the rig has."""
        return next(iter(self.cameras))

    @property
    def unit(self) -> str:
        """Unit of the world coordinates."""
        return self.cameras[self.first].unit

    @property
    def frame_names(self) -> FrameNames:
        """The frames of all views of the points; those that determine the rig are the first."""
        place = {view: k for k, views in enumerate(self.frames.values()) for view in views.items()}
        names, of_views = list(self.frames), []
        for camera, one in self.cameras.items():
            views = [(camera, view) for view in one.points.view_names]
            alone = [view for view in views if view not in place]
            place |= {view: len(names) + k for k, view in enumerate(alone)}
            names += map("/".join, alone)
            of_views.append(np.array([place[view] for view in views], dtype=np.intp))
        return FrameNames(tuple(names), tuple(of_views))

    @property
    def edges(self) -> dict[tuple[str, str], int]:
        """Number of frames that determine the rig by pairs of cameras, as far as they have any in common."""
        seen = Counter(
            pair
            for views in self.frames.values()
            for pair in combinations([name for name in self.cameras if name in views], 2)
        )
        return {pair: seen[pair] for pair in combinations(self.cameras, 2) if pair in seen}

    def pair(self, left: str, right: str) -> StereoRig:
        """Two of the cameras as a stereo rig, with the covariance of their relative pose.

        Raises InputError for a name that no camera has, or one camera given twice.
        """
        for name in (left, right):
            if name not in self.cameras:
                raise InputError(f"the rig has no camera {name!r}; give two of {', '.join(self.cameras)}")
        if left == right:
            raise InputError(f"{left!r} is given twice; give two cameras")
        if left == self.first:
            at = 6 * (list(self.poses).index(right) - 1)
            covariance, std = self.covariance[at : at + 6, at : at + 6], self.pose_std[right]
            pose = self.poses[right]
        else:
            pose = self.poses[right].relative_to(self.poses[left])
            covariance = self._relative_covariance((left, right), pose)
            std = named_std(covariance, pose.t)
        names, cameras = (left, right), [self.cameras[left], self.cameras[right]]
        both = [views for views in self.frames.values() if {left, right} <= set(views)]
        found = StereoRig(
            *of_two(names, cameras, pose, std, covariance, [(views[left], views[right]) for views in both]),
            converged=self.converged, stop_reason=self.stop_reason, iterations=self.iterations,
            max_px=max(camera.max_px for camera in cameras),
        )  # fmt: skip
        if names == tuple(self.cameras):
            return replace(
                found,
                views_left_out=self.views_left_out,
                delays=self.delays,
                timed=self.timed,
                rmse_px=self.rmse_px,
                warnings=self.warnings,
                judgement=self.judgement,
            )
        counts = [len(camera.points) for camera in cameras]
        squares = sum(n * float(c.rmse_px) ** 2 for n, c in zip(counts, cameras, strict=True) if n)
        return replace(
            found,
            rmse_px=(squares / sum(counts)) ** 0.5 if sum(counts) else self.rmse_px,
            judgement=self.judgement if isinstance(self.judgement, Verdict) else None,
        )

    @property
    def pairs_left_out(self) -> dict[tuple[str, str], str]:
        """Of two cameras, the pairs of views that contradict the rig, with the reason."""
        left, right = ([view for one, view in self.views_left_out if one == name] for name in self.cameras)
        if not (left and right):
            return {}
        first = self.first
        return {(a, b): self.views_left_out[first, a] for a, b in pair_views(left, right)}

    def _relative_covariance(self, names: tuple[str, str], pose: Pose) -> Array:
        """(6, 6) covariance of the angles and the translation from one camera to another."""
        places = {name: 6 * k + np.arange(6) for k, name in enumerate(list(self.poses)[1:])}
        J = np.zeros((6, len(self.covariance)))
        for name, by in zip(names, relative_steps(*(self.poses[name] for name in names)), strict=True):
            if name in places:
                J[:, places[name]] = by @ steps_by_angles(self.poses[name].R)
        J[:3] = euler_jacobian(pose.R) @ J[:3]
        return np.asarray(J @ self.covariance @ J.T)


@frozen_dataclass(eq=False)
class StereoRig(Rig):
    """A rig of two cameras, of which the first is the left one.

    A view of both cameras has one pose: that in the right camera is that in the left one, transformed by the
    rig.
    """

    _summary = ("commands.show.rig_report", "stereo_report")

    def __repr__(self) -> str:
        std = self.std.get("baseline", float("nan"))
        return (
            f"StereoRig of {self.left.camera_name!r} and {self.right.camera_name!r}: {len(self.pairs)} pairs "
            f"of views, rms {self.rmse_px:.4g} px\n"
            f"  baseline {self.baseline:.6g} +- {std:.2g} {self.unit}; see .left, .right and .summary()"
        )

    @property
    def left(self) -> Calibration:
        """The left camera."""
        return self.cameras[self.first]

    @property
    def right(self) -> Calibration:
        """The right camera."""
        return self.cameras[self._second]

    @property
    def pose(self) -> Pose:
        """R and t, ``X_right = R X_left + t``."""
        return self.poses[self._second]

    @property
    def std(self) -> Mapping[str, float]:
        """Standard deviation of R_x, R_y, R_z [rad], t_x, t_y, t_z and baseline [world unit]."""
        return self.pose_std[self._second]

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Left and right names of the views that determine the rig."""
        return tuple((views[self.first], views[self._second]) for views in self.frames.values())

    @property
    def left_out(self) -> dict[tuple[str, str], str]:
        """Pairs of views that contradict the rig, with the reason; each contributes to its own camera."""
        return self.pairs_left_out

    @property
    def delay(self) -> tuple[float, float] | None:
        """By how much the right images were taken later than the left ones, and its std; see `Rig`."""
        return self.delays.get(self._second)

    @property
    def R(self) -> Array:
        """(3, 3) rotation from the left camera's frame to the right one's."""
        return self.pose.R

    @property
    def t(self) -> Array:
        """(3,) centre of the left camera in the right one's frame [world unit]."""
        return self.pose.t

    @property
    def alone(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Views of the left camera alone and of the right camera alone."""
        return unpaired(self.left.views, self.right.views, [*self.pairs, *self.left_out])

    @property
    def baseline(self) -> float:
        """Distance of the cameras [world unit]."""
        return float(np.linalg.norm(self.pose.t))

    @property
    def E(self) -> Array:
        """(3, 3) essential matrix [t]x R: x_right^T E x_left = 0."""
        return np.asarray(cross_matrix(self.t) @ self.R)

    @property
    def F(self) -> Array:
        """(3, 3) fundamental matrix A_right^-T E A_left^-1 of unit norm: m_right^T F m_left = 0.

        m are undistorted pixels.
        """
        F = np.linalg.solve(self.right.intrinsics.A.T, self.E) @ np.linalg.inv(self.left.intrinsics.A)
        return np.asarray(F / np.linalg.norm(F))

    @property
    def _second(self) -> str:
        return list(self.cameras)[1]


def of_two(
    names: tuple[str, str],
    cameras: Sequence[Calibration],
    pose: Pose,
    std: Mapping[str, float],
    covariance: Array,
    pairs: Iterable[tuple[str, str]],
) -> tuple[Any, ...]:
    """The first arguments of a rig of two cameras, left and right, with the views of both."""
    left, right = names
    exact = dict.fromkeys((*POSE_NAMES, "baseline"), 0.0)
    return (
        dict(zip(names, cameras, strict=True)),
        {left: Pose(np.eye(3), np.zeros(3)), right: pose},
        {left: exact, right: std},
        covariance,
        {a: {left: a, right: b} for a, b in pairs},
    )


def steps_by_angles(R: Array) -> Array:
    """(6, 6) steps w, tau of a pose (exp(w) R, t + tau), by its angles and translation."""
    J = np.eye(6)
    J[:3, :3] = np.linalg.pinv(euler_jacobian(R))
    return J


def relative_steps(first: Pose, second: Pose) -> tuple[Array, Array]:
    """(6, 6) steps w, tau of the pose R_b R_a^T from a first to a second camera, by those of both poses."""
    R = second.R @ first.R.T
    by_first, by_second = np.asarray(-np.kron(np.eye(2), R)), np.asarray(np.eye(6))
    for by in (by_first, by_second):
        by[3:, :3] = cross_matrix(R @ first.t) @ by[:3, :3]
    return by_first, by_second


def named_std(covariance: Array, t: Array) -> dict[str, float]:
    """Standard deviations of angles and translation by name, and of the baseline."""
    distance = float(np.linalg.norm(t))
    along = t / distance if distance > 0 else np.zeros(3)
    std = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    named = dict(zip(POSE_NAMES, std.tolist(), strict=True))
    return named | {"baseline": float(np.sqrt(max(float(along @ covariance[3:, 3:] @ along), 0.0)))}
