"""Whether the cameras of a rig, or their poses, have changed since an earlier calibration.

A rig that was calibrated with cameras that were given as another rig has them shares their errors with it:
those d of their parameters, which its poses y follow as F d, and what the choice of their lenses leaves open,
by which both are wrong alike. So the covariance of the difference from the poses x of the other rig is that
of F d - x and of the noise of y.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neurocal_cli.adjustment.normal_equations import NOTHING
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.drift import FEW_VIEWS, SHARE, Drift, find_drift, tail
from neurocal_cli.calibration.rig.covariance import covariance_by_points, following_given, given_covariance
from neurocal_cli.calibration.rig.fit import fit_rig
from neurocal_cli.calibration.rig.rig import Rig, StereoRig, steps_by_angles
from neurocal_cli.calibration.rig.space_uncertainty import fitted, has_points, steps_between
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, rotation_vector
from neurocal_cli.errors import InputError, NeurocalError

Differences = Callable[[str, str], Array]
"""(6, 6) covariance of the difference of two rigs' poses from one camera to another, as turn and shift."""


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
    # Cameras that were given as the old rig has them, whose errors count twice, as a rig lacks its points.
    twice: tuple[str, ...] = ()

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
    return _of_poses(old, new, cameras)


def moved_since(rig: Rig, seen: Mapping[str, Calibration]) -> RigDrift | None:
    """Compare the poses of a rig with those that new frames give its cameras, which are as they were.

    None if the frames do not determine the poses, or of fewer than two cameras.
    """
    if len(seen) < 2:
        return None
    try:
        return _of_poses(rig, fit_rig({name: seen[name] for name in rig.cameras if name in seen}), {})
    except NeurocalError:
        return None


def _of_poses(old: Rig, new: Rig, cameras: Mapping[str, Drift]) -> RigDrift:
    known = differences(old, new)
    twice = () if has_points(old) and has_points(new) else tuple(_alike(old, new))

    def seen_from(reference: str) -> RigDrift:
        others = [name for name in new.cameras if name != reference]
        poses = {name: find_pose_drift(old, new, name, reference, known) for name in others}
        return RigDrift(cameras, poses, old.unit, reference, twice)

    found = seen_from(new.first)
    if len(found.moved) <= len(found.poses) / 2:
        return found
    return min((seen_from(name) for name in new.cameras), key=lambda one: len(one.moved) or len(new.cameras))


def find_pose_drift(
    old: Rig, new: Rig, name: str, reference: str | None = None, known: Differences | None = None
) -> PoseDrift:
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
    if old.unit != new.unit or (reference is None and old.first != new.first):
        raise InputError(
            f"the poses are relative to {old.first} in {old.unit} and to {new.first} in {new.unit}; "
            "calibrate both rigs alike"
        )
    reference = reference or old.first
    before, after = (rig.pair(reference, name) for rig in (old, new))
    difference = np.concatenate([rotation_vector(after.R @ before.R.T), after.t - before.t])
    baseline = after.baseline - before.baseline
    covariance = (known or differences(old, new))(reference, name)
    along = np.concatenate([np.zeros(3), after.t / max(after.baseline, NOTHING)])
    *of_step, of_baseline = np.append(np.diagonal(covariance), along @ covariance @ along).tolist()
    std, baseline_std = np.sqrt(np.maximum(of_step, 0.0)), float(np.sqrt(max(of_baseline, 0.0)))
    values, stds = np.append(difference, baseline), np.append(std, baseline_std)
    if not np.isfinite(stds).all():
        raise InputError(f"the standard deviations of the pose of {name} are unknown; take more views of it")
    ratios = np.divide(values, stds, out=np.zeros(7), where=values != 0)
    views = sum(len(rig.frames) - 1.0 if len(rig.frames) > 1 else FEW_VIEWS for rig in (old, new))
    share = min(1.0, 7 * min(tail(ratio, 1.0, views) for ratio in (ratios**2).tolist()))
    return PoseDrift(difference[:3], std[:3], difference[3:], std[3:], baseline, baseline_std, share)


def _covariance(pair: StereoRig) -> Array:
    """The (6, 6) covariance of a small turn of R and of t."""
    J = steps_by_angles(pair.R)
    return np.asarray(J @ pair.covariance @ J.T)


def differences(old: Rig, new: Rig) -> Differences:
    """The covariances of the differences of two rigs' poses.

    Where a rig was written without its points, what they share is not known, and counts twice.
    """
    names = [list(rig.cameras) for rig in (old, new)]
    alike = _alike(old, new)
    if not (alike and has_points(old) and has_points(new)):
        return lambda *pair: _covariance(old.pair(*pair)) + _covariance(new.pair(*pair))
    before, after = fitted(old), fitted(new)
    d = np.zeros((after.state.columns.n_shared, before.state.columns.n_shared))  # as the old rig has them
    for name in alike:
        one, other = (own.index(name) for own in names)
        place, its = after.state.columns.cameras[other], before.state.columns.cameras[one]
        d[place, its] = 1.0
        d[place[:5], its[:5]] = before.problem.observations[one].views.pixel_scale
        d[place[:5], its[:5]] /= after.problem.observations[other].views.pixel_scale
        if before.state.cameras[one].square:
            d[place[2], its[[0, 2]]] = d[place[0], its[0]], 0.0
    follow, given, shared = following_given(after), given_covariance(after), d.any(axis=1)
    given[:, ~shared] = given[~shared] = 0.0
    rest = covariance_by_points(after).shared - follow @ given @ follow.T
    known = covariance_by_points(before).shared

    def between(first: str, second: str) -> Array:
        sides = [(own.index(first), own.index(second)) for own in names]
        by_old, by_new = (steps_between(fit, *pair) for fit, pair in zip((before, after), sides, strict=True))
        apart = by_new @ follow @ d - by_old
        return np.asarray(apart @ known @ apart.T + by_new @ rest @ by_new.T)

    return between


def _alike(old: Rig, new: Rig) -> list[str]:
    """The cameras that were given to the new rig with the parameters that they have in the old one."""
    both = {name: (camera, old.cameras[name]) for name, camera in new.cameras.items() if name in old.cameras}
    return [
        name
        for name, (camera, before) in both.items()
        if camera.given_names
        and camera.intrinsics == before.intrinsics
        and camera.camera.distortion == before.camera.distortion
    ]
