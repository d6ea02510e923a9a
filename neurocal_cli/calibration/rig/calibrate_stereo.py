"""Calibration of two cameras, left and right: a rig of two, with what users of stereo cameras expect."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.calibration.calibrate import CameraOptions
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.common_target import on_one_target
from neurocal_cli.calibration.rig.adjust import adjust_rig
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_rig
from neurocal_cli.calibration.rig.combine import stereo_problem
from neurocal_cli.calibration.rig.fit import fit_rig
from neurocal_cli.calibration.rig.pairing import ViewPairs
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.stereo_rig import StereoRig
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences

if TYPE_CHECKING:
    from typing_extensions import Unpack

_SIDES = ("left", "right")


def calibrate_stereo(
    left: Correspondences,
    right: Correspondences,
    left_options: CameraOptions | None = None,
    right_options: CameraOptions | None = None,
    *,
    progress: Progress | None = None,
    **options: Unpack[CameraOptions],
) -> StereoRig:
    """Calibrate two cameras and their rig from random weights.

    It is `calibrate_rig` of two cameras, whose views are paired by name; see there.

    Parameters
    ----------
    left, right : Correspondences
        In one world unit. Views are paired by name, points by id, else by X, Y, Z (see `pairing`).
    left_options, right_options : dict, optional
        Arguments of `calibrate` for one camera, such as ``type=3, intrinsics=camera`` for a known one.
    progress : callable, optional
        Called with the name of a stage and the share of it that is done.
    **options
        Arguments of `calibrate` for both cameras. `outliers` also applies to pairs of views that contradict
        the others.

    Returns
    -------
    StereoRig
        ``X_right = R X_left + t``.

    Raises
    ------
    UsageError
        As `calibrate`; an option that it does not have; type 4, where all poses are known.
    InputError, DegenerateGeometryError
        The points do not determine the rig; the message says why.
    """
    extra = dict(zip(_SIDES, (left_options or {}, right_options or {}), strict=True))
    points = dict(zip(_SIDES, (left, right), strict=True))
    return _stereo(calibrate_rig(points, extra, progress=progress, **options))


def fit_stereo(
    left: Calibration,
    right: Calibration,
    *,
    refine_cameras: bool = False,
    outliers: str = "reject",
    target_kept: bool = False,
) -> StereoRig:
    """Find the pose of the right camera relative to the left one from the views of both.

    Parameters
    ----------
    left, right : Calibration
    refine_cameras : bool
        Whether the bundle adjustment also refines the intrinsic parameters and distortions that were
        estimated. Otherwise it refines the rig and the poses alone.
    outliers : {"reject", "keep"}
        Whether pairs of views that contradict most others are left out of the rig with a warning, or raise.
    target_kept : bool
        Whether the given target was kept although it could have been estimated from both cameras.

    Returns
    -------
    StereoRig

    Raises
    ------
    InputError
        No pairs of views, or views without common points; see `pairing`.
    DegenerateGeometryError
        Views that contradict each other.
    CoincidentCamerasError
        Cameras at one place.
    UsageError
        An unknown option.
    """
    cameras = dict(zip(_SIDES, on_one_target(left, right), strict=True))
    return _stereo(
        fit_rig(cameras, refine_cameras=refine_cameras, outliers=outliers, target_kept=target_kept)
    )


def _stereo(rig: Rig) -> StereoRig:
    pair = rig.pair(*_SIDES)
    return replace(pair, warnings=(*pair.warnings, *_swapped(pair)))


def _swapped(rig: StereoRig) -> tuple[str, ...]:
    """A warning where the right camera is on the left."""
    centre = -rig.R.T @ rig.t  # of the right camera in the left camera's frame
    if centre[0] >= 0 or abs(centre[0]) <= abs(centre[1]):
        return ()
    return (
        f"the right camera is {-centre[0]:.4g} {rig.unit} to the left of the left one; if they "
        "are swapped, give the left camera first",
    )


def poses_on_rig(rig: Pose, cameras: tuple[Calibration, Calibration], views: ViewPairs) -> dict[str, Pose]:
    """Poses of views in the left camera's frame that fit both cameras of a known rig best, by its names.

    The cameras have the poses of the views in each camera alone.
    """
    problem = stereo_problem(*cameras, views.both)
    start = problem.start([rig])
    state = adjust_rig(problem, start, np.zeros(start.columns.n_shared, dtype=bool)).state
    R, t = problem.world_poses(state, side=0)
    return {name: Pose(R[k], t[k]) for k, name in enumerate(problem.names[0])}
