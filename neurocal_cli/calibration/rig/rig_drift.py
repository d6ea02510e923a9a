"""Whether the cameras of a rig, or their poses, have changed since an earlier calibration."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from neurocal_cli.calibration.drift import FEW_VIEWS, SHARE, Drift, find_drift, tail
from neurocal_cli.calibration.rig.rig import Rig, StereoRig
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, euler_jacobian, rotation_vector
from neurocal_cli.errors import InputError


@frozen_dataclass(eq=False)
class PoseDrift:
    """What changed in the pose of a camera relative to another camera of its rig.

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


@frozen_dataclass(eq=False)
class RigDrift:
    """What changed from an old calibration of a rig to a new one."""

    cameras: Mapping[str, Drift]
    poses: Mapping[str, PoseDrift]  # of all cameras but one, relative to it
    unit: str  # of lengths
    reference: str  # the camera to which the poses are relative

    @property
    def limit(self) -> float:
        """Share of pairs of calibrations below which one of the answers is no chance."""
        return SHARE / (len(self.cameras) + len(self.poses))

    @property
    def changed(self) -> tuple[str, ...]:
        """Names of the cameras that have changed."""
        return tuple(name for name, one in self.cameras.items() if one.share < self.limit)

    @property
    def moved(self) -> tuple[str, ...]:
        """Names of the cameras that have moved relative to the reference."""
        return tuple(name for name, one in self.poses.items() if one.share < self.limit)

    @property
    def different(self) -> bool:
        """Whether the rig has changed: unchanged ones are called different in one of 1000 cases."""
        return bool(self.changed or self.moved)


def find_rig_drift(old: Rig, new: Rig) -> RigDrift:
    """Compare a new calibration of a rig with an old one: each camera, and its pose relative to the first.

    If most cameras have moved relative to the first, their poses are relative to the camera to which the
    fewest have moved: where the first one alone was knocked, it is the one that moved.

    Raises
    ------
    InputError
        The rigs have other cameras, or a camera or a pose cannot be compared; the message names it.
    """
    if set(old.cameras) != set(new.cameras):
        raise InputError(
            f"the rigs have different cameras: {', '.join(old.cameras)}, and {', '.join(new.cameras)}; "
            "give the cameras of both the same names"
        )
    cameras = {}
    for name, camera in old.cameras.items():
        try:
            cameras[name] = find_drift(camera, new.cameras[name])
        except InputError as error:
            raise InputError(f"camera {name}: {error}") from error

    def seen_from(reference: str) -> RigDrift:
        others = [name for name in old.cameras if name != reference]
        poses = {name: find_pose_drift(old, new, name, reference) for name in others}
        return RigDrift(cameras, poses, old.unit, reference)

    found = seen_from(old.first)
    if len(found.moved) <= len(found.poses) / 2:
        return found
    return min((seen_from(name) for name in old.cameras), key=lambda one: len(one.moved) or len(old.cameras))


def find_pose_drift(old: Rig, new: Rig, name: str, reference: str | None = None) -> PoseDrift:
    """Compare the pose of a camera in a new calibration of a rig with that in an old one.

    The pose is relative to another camera of the rig, by default the first.

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
    before, after = (rig.pair(reference or old.first, name) for rig in (old, new))
    difference = np.concatenate([rotation_vector(after.R @ before.R.T), after.t - before.t])
    baseline = after.baseline - before.baseline
    std = np.sqrt(np.diag(_covariance(before) + _covariance(after)))
    baseline_std = float(np.hypot(before.std["baseline"], after.std["baseline"]))
    values, stds = np.append(difference, baseline), np.append(std, baseline_std)
    if not np.isfinite(stds).all():
        raise InputError(f"the standard deviations of the pose of {name} are unknown; take more views of it")
    ratios = np.divide(values, stds, out=np.zeros(7), where=values != 0)
    views = sum(len(rig.frames) - 1.0 if len(rig.frames) > 1 else FEW_VIEWS for rig in (old, new))
    share = min(1.0, 7 * min(tail(ratio, 1.0, views) for ratio in (ratios**2).tolist()))
    return PoseDrift(difference[:3], std[:3], difference[3:], std[3:], baseline, baseline_std, share)


def _covariance(pair: StereoRig) -> Array:
    """The (6, 6) covariance of a small turn of R and of t."""
    J = np.eye(6)
    J[:3, :3] = np.linalg.pinv(euler_jacobian(pair.R))  # the turn that changes the angles
    return np.asarray(J @ pair.covariance @ J.T)
