"""Two calibrations as one normalised problem, with common frames of the views and a start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.point_batches import batches_of
from neurocal_cli.bundle_adjustment.reprojection import CameraState, normal_blocks
from neurocal_cli.bundle_adjustment.reweighting import weighed
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.calibration import Calibration, estimated_parameters
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.evaluation import evaluate_camera
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.median import median
from neurocal_cli.stereo.pairing import ViewPairs
from neurocal_cli.stereo.reprojection import Frames, Observations, RigState

# Smaller noise, as a share of the other camera's and in normalised pixels, is rounding in data without noise;
# test_without_noise_the_truth_comes_back checks such data.
_LEAST_SHARE = 1e-3
_LEAST_NOISE = 1e-12


@frozen_dataclass(eq=False)
class RigProblem:
    """Observations of both cameras in common frames, and the poses in each camera alone.

    Attributes
    ----------
    calibrations : two of Calibration
        Each camera alone.
    names : two tuples of str
        Views of each camera, in the order of its observations.
    frames : Frames
        Of the left camera's views, in their order, then of the views of the right camera alone.
    observations : two of Observations
    cameras : two of CameraState
        As calibrated alone, with the poses of the views.
    own_normal : two (V_c, 12 + K, 12 + K) arrays
        Whitened normal matrices of each view in its camera alone, from `normal_blocks`.
    paired : (P,) int array
        Frames of both cameras.
    paired_right : (P,) int array
        Their indices among the right camera's views.
    spread : (P, 5, 3) array
        Of each paired target, in local coordinates: its centre, and points one rms extent from it in both
        directions along its two longest axes.
    axes : (P, 3, 3) array
        Principal axes of the target as columns, the longest first.
    flat : (P,) bool array
    """

    calibrations: tuple[Calibration, Calibration]
    names: tuple[tuple[str, ...], tuple[str, ...]]
    frames: Frames
    observations: tuple[Observations, Observations]
    cameras: tuple[CameraState, CameraState]
    own_normal: tuple[Array, Array]
    paired: NDArray[np.intp]
    paired_right: NDArray[np.intp]
    spread: Array
    axes: Array
    flat: NDArray[np.bool_]

    @property
    def estimated(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """`estimated_parameters` of the left and of the right camera."""
        left, right = self.calibrations
        return estimated_parameters(left), estimated_parameters(right)

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Left and right names of the paired views."""
        left, right = self.names
        return [(left[a], right[b]) for a, b in zip(self.paired, self.paired_right, strict=True)]

    def start(self, rig: Pose) -> RigState:
        """The calibrated cameras with the left one's poses, and the right one's for its single views."""
        left, right = self.cameras
        R = np.concatenate([left.R, np.zeros((len(self.frames.scale) - len(left.R), 3, 3))])
        t = np.concatenate([left.t, np.zeros((len(R) - len(left.t), 3))])
        alone = np.flatnonzero(~self.frames.in_both[self.observations[1].view])
        frame = self.observations[1].view[alone]
        R[frame], t[frame] = right.R[alone], right.t[alone]
        return RigState(self.cameras, rig.R.copy(), rig.t / self.frames.unit, R, t)


def free_parameters(calibration: Calibration) -> NDArray[np.bool_]:
    """(5 + K,) which of A's entries and the distortion coefficients a common fit may move.

    With a distortion from straight lines none is, as camera and distortion belong together.
    """
    return estimated_parameters(calibration) & (calibration.straight_lines is None)


def rig_problem(left: Calibration, right: Calibration, views: ViewPairs) -> RigProblem:
    """Combine two calibrations with one world unit."""
    # Covariances of the points count as far as the residuals confirm them.
    arranged = [weighed(camera.points, evaluate_camera(camera).residuals) for camera in (left, right)]
    names = arranged[0].names, arranged[1].names
    place = {b: names[0].index(a) for a, b in views.both}
    n_left = len(names[0])
    frame = np.array([place.get(name, -1) for name in names[1]])
    alone = np.flatnonzero(frame < 0)
    frame[alone] = n_left + np.arange(len(alone))
    through = np.zeros(n_left + len(alone), dtype=bool)
    through[frame[frame < n_left]] = True
    frames = Frames(
        np.concatenate([arranged[0].centre, arranged[1].centre[alone]]),
        scale := np.concatenate([arranged[0].scale, arranged[1].scale[alone]]),
        through,
        float(median(scale)),
    )
    sides = [
        _side(calibration, view, frames, frame_of)
        for calibration, view, frame_of in zip(
            (left, right), arranged, (np.arange(n_left), frame), strict=True
        )
    ]
    noise = [max(side[3], _LEAST_NOISE) for side in sides]
    real = [observed.pixel_scale * s for (observed, *_), s in zip(sides, noise, strict=True)]
    observations, normals = [], []
    for (observed, _, normal, _), s, own in zip(sides, noise, real, strict=True):
        weight = 1.0 / (s * max(1.0, _LEAST_SHARE * max(real) / own)) ** 2
        observations.append(replace(observed, weight=weight))
        normals.append(weight * normal)
    paired_right = np.flatnonzero(through[frame] & (frame < n_left))
    paired = frame[paired_right]
    return RigProblem(
        (left, right), names, frames, (observations[0], observations[1]), (sides[0][1], sides[1][1]),
        (normals[0], normals[1]), paired, paired_right, _spread(arranged[0], paired),
        arranged[0].basis[paired], arranged[0].nearly_flat[paired],
    )  # fmt: skip


def _side(
    calibration: Calibration, views: Views, frames: Frames, frame: NDArray[np.intp]
) -> tuple[Observations, CameraState, Array, float]:
    """Normalised observations of one camera (without weight), its state, normal matrices and noise."""
    centre, scale = frames.centre[frame], frames.scale[frame]
    local = views.local * np.repeat(views.scale / scale, views.counts)[:, None]
    local += np.repeat((views.centre - centre) / scale[:, None], views.counts, axis=0)
    batches = batches_of(local, views.pixels, views.whitening, views.index, views.n_views)
    entries = calibration.K[ENTRIES]
    entries[3:] -= views.pixel_centre
    poses = [calibration.views[name].pose for name in views.names]
    R, t = np.stack([pose.R for pose in poses]), np.stack([pose.t for pose in poses])
    state = CameraState(
        entries[None] / views.pixel_scale,
        R,
        ((R @ centre[..., None])[..., 0] + t) / scale[:, None],
        calibration.distortion_model,
        np.array(calibration.distortion, dtype=float),
    )
    normal = normal_blocks(batches, state)[0]
    cost = normal[:, -1, -1]
    spare = views.n_equations - int(free_parameters(calibration).sum()) - 6 * views.n_views
    noise = float(np.sqrt(cost.sum() / max(spare, 1)))
    observed = Observations(
        batches, frame, views.pixel_centre, views.pixel_scale, 1.0, len(views.index), views.n_equations
    )
    return observed, state, normal, noise


def _spread(views: Views, which: NDArray[np.intp]) -> Array:
    along = views.basis[which] * views.extent[which][:, None, :]  # (P, 3, axis)
    first, second = along[:, :, 0], along[:, :, 1]
    return np.stack([np.zeros_like(first), first, -first, second, -second], axis=1)
