"""Two calibrations as one normalised problem, with common frames of the views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.point_batches import batches_of
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.reweighting import weighed
from neurocal_cli.adjustment.views import Views
from neurocal_cli.calibration.calibration import Calibration, estimated_parameters
from neurocal_cli.calibration.evaluation import evaluate_camera
from neurocal_cli.calibration.rig.adjust import Observations, RigProblem
from neurocal_cli.calibration.rig.pairing import ViewPairs
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.median import median
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState

# Smaller noise, as a share of the other camera's and in normalised pixels, is rounding in data without noise;
# test_without_noise_the_truth_comes_back checks such data.
_LEAST_SHARE = 1e-3
_LEAST_NOISE = 1e-12


def free_parameters(calibration: Calibration) -> NDArray[np.bool_]:
    """(5 + K,) which of A's entries and the distortion coefficients a common fit may move.

    With a distortion from straight lines none is, as camera and distortion belong together.
    """
    return estimated_parameters(calibration) & (calibration.straight_lines is None)


def rig_problem(left: Calibration, right: Calibration, views: ViewPairs) -> RigProblem:
    """Combine two calibrations with one world unit."""
    cameras = left, right
    # Covariances of the points count as far as the residuals confirm them.
    arranged = [weighed(camera.points, evaluate_camera(camera).residuals) for camera in cameras]
    names = arranged[0].names, arranged[1].names
    place = {b: names[0].index(a) for a, b in views.both}
    n_left = len(names[0])
    frame = np.array([place.get(name, -1) for name in names[1]])
    alone, paired_right = np.flatnonzero(frame < 0), np.flatnonzero(frame >= 0)
    paired = frame[paired_right]
    frame[alone] = n_left + np.arange(len(alone))
    centre = np.concatenate([arranged[0].centre, arranged[1].centre[alone]])
    scale = np.concatenate([arranged[0].scale, arranged[1].scale[alone]])
    sides = [
        _side(camera, own, centre[which], scale[which], which)
        for camera, own, which in zip(cameras, arranged, (np.arange(n_left), frame), strict=True)
    ]
    seen, states, normals, noise = zip(*sides, strict=True)
    real = [observed.pixel_scale * s for observed, s in zip(seen, noise, strict=True)]
    weights = [
        1.0 / (s * max(1.0, _LEAST_SHARE * max(real) / own)) ** 2 for s, own in zip(noise, real, strict=True)
    ]
    return RigProblem(
        calibrations=cameras,
        names=names,
        centre=centre,
        scale=scale,
        unit=float(median(scale)),
        observations=(replace(seen[0], weight=weights[0]), replace(seen[1], weight=weights[1])),
        cameras=(states[0], states[1]),
        own_normal=(weights[0] * normals[0], weights[1] * normals[1]),
        paired=paired,
        paired_right=paired_right,
        spread=_spread(arranged[0], paired),
        axes=arranged[0].basis[paired],
        flat=arranged[0].nearly_flat[paired],
    )


def _side(
    calibration: Calibration, views: Views, centre: Array, scale: Array, frame: NDArray[np.intp]
) -> tuple[Observations, CameraState, Array, float]:
    """Normalised observations of one camera (without weight), its state, normal matrices and noise.

    `centre` (V_c, 3) and `scale` (V_c,) are those of the views' frames.
    """
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
    spare = views.n_equations - int(free_parameters(calibration).sum()) - 6 * views.n_views
    noise = max(float(np.sqrt(normal[:, -1, -1].sum() / max(spare, 1))), _LEAST_NOISE)
    observed = Observations(batches, frame, views.pixel_centre, views.pixel_scale, 1.0, views.n_equations)
    return observed, state, normal, noise


def _spread(views: Views, which: NDArray[np.intp]) -> Array:
    along = views.basis[which] * views.extent[which][:, None, :]  # (P, 3, axis)
    first, second = along[:, :, 0], along[:, :, 1]
    return np.stack([np.zeros_like(first), first, -first, second, -second], axis=1)
