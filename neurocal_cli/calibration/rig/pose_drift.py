"""Whether a camera of a rig has moved relative to the first one since an earlier calibration."""

from __future__ import annotations

import numpy as np

from neurocal_cli.calibration.drift import FEW_VIEWS, SHARE, tail
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, euler_jacobian, rotation_vector
from neurocal_cli.errors import InputError


@frozen_dataclass(eq=False)
class PoseDrift:
    """What changed in the pose of a camera relative to the first camera of its rig.

    The standard deviations are those of the differences, from both calibrations.
    """

    turn: Array  # (3,) [rad] of the camera about its x, y and z
    turn_std: Array  # (3,)
    shift: Array  # (3,) [world unit] new minus old t
    shift_std: Array  # (3,)
    baseline: float  # new minus old distance of the two cameras
    baseline_std: float
    share: float  # of pairs of calibrations of an unchanged rig that differ as much

    @property
    def different(self) -> bool:
        """Whether the camera has moved."""
        return self.share < SHARE


def find_pose_drift(old: Rig, new: Rig, name: str) -> PoseDrift:
    """Compare the pose of a camera in a new calibration of a rig with that in an old one.

    Seven numbers are compared with their standard deviations: three angles, three coordinates and the
    baseline. Student's distribution allows for the few views from which the standard deviations come. The
    numbers are not combined, because the best known combination of parameters is known less well than its
    covariance says; see `drift`.

    Raises
    ------
    InputError
        The rigs have other first cameras or units, or the standard deviations are unknown.
    """
    if (old.first, old.unit) != (new.first, new.unit):
        raise InputError(
            f"the poses are relative to {old.first} in {old.unit} and to {new.first} in {new.unit}; "
            "calibrate both rigs alike"
        )
    (before, of_old), (after, of_new) = _pose(old, name), _pose(new, name)
    difference = np.concatenate([rotation_vector(after[0] @ before[0].T), after[1] - before[1]])
    baseline = float(np.linalg.norm(after[1]) - np.linalg.norm(before[1]))
    std = np.sqrt(np.diag(of_old + of_new))
    baseline_std = float(np.hypot(old.std[name]["baseline"], new.std[name]["baseline"]))
    values, stds = np.append(difference, baseline), np.append(std, baseline_std)
    if not np.isfinite(stds).all():
        raise InputError(f"the standard deviations of the pose of {name} are unknown; take more views of it")
    ratios = np.divide(values, stds, out=np.zeros(7), where=values != 0)
    views = sum(len(rig.frames) - 1.0 if len(rig.frames) > 1 else FEW_VIEWS for rig in (old, new))
    share = min(1.0, 7 * min(tail(ratio, 1.0, views) for ratio in (ratios**2).tolist()))
    return PoseDrift(difference[:3], std[:3], difference[3:], std[3:], baseline, baseline_std, share)


def _pose(rig: Rig, name: str) -> tuple[tuple[Array, Array], Array]:
    """R and t of a camera, and the (6, 6) covariance of a small turn of R and of t."""
    at = 6 * (list(rig.poses).index(name) - 1)
    pose, covariance = rig.poses[name], rig.covariance[at : at + 6, at : at + 6]
    J = np.eye(6)
    J[:3, :3] = np.linalg.pinv(euler_jacobian(pose.R))  # the turn that changes the angles
    return (pose.R, pose.t), J @ covariance @ J.T
