"""A stereo rig, or two cameras of a larger one, with their relative pose, ``X_right = R X_left + t``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, replace

import numpy as np

from neurocal_cli.calibration.calibration import Calibration, Verdict
from neurocal_cli.calibration.rig.fixed_cameras import FixedCameras
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, cross_matrix
from neurocal_cli.camera.pinhole import Pose


@frozen_dataclass(eq=False)
class StereoRig(FixedCameras):
    """Two calibrated cameras on one rig.

    Attributes
    ----------
    left, right : Calibration
        A view of both cameras has one pose: that in the right camera is that in the left one, transformed by
        the rig.
    pose : Pose
        R and t, ``X_right = R X_left + t``.
    std : dict
        Standard deviation of R_x, R_y, R_z [rad], t_x, t_y, t_z and baseline [world unit].
    covariance : (6, 6) array
        Of R_x, R_y, R_z, t_x, t_y, t_z.
    pairs : tuple of (left name, right name)
        The views that determine the rig.
    left_out : dict of str by (left name, right name)
        Views that contradict the rig, with the reason; each contributes to its own camera.
    delay : tuple of float, optional
        By how much the right images were taken later than the left ones, and its std; see `Rig`.
    timed : bool
    rmse_px : float [px]
        ``sqrt(mean(du^2 + dv^2))`` over all points of both cameras.
    max_px : float [px]
    converged : bool
    stop_reason : str
    iterations : int
        Iterations of the common bundle adjustment.
    warnings : tuple of str
    judgement : Verdict or callable, optional
        The verdict read from a file, or the function that computes it from this rig; see `verdict`.
    """

    left: Calibration
    right: Calibration
    pose: Pose
    std: Mapping[str, float]
    covariance: Array
    pairs: tuple[tuple[str, str], ...]
    left_out: Mapping[tuple[str, str], str] = field(default_factory=dict)
    delay: tuple[float, float] | None = None
    timed: bool = False
    rmse_px: float = float("nan")
    max_px: float = float("nan")
    converged: bool = True
    stop_reason: str = ""
    iterations: int = 0
    warnings: tuple[str, ...] = ()
    judgement: Verdict | Callable[[StereoRig], Verdict | None] | None = None

    _summary = ("commands.show.rig_report", "stereo_report")

    def __repr__(self) -> str:
        std = self.std.get("baseline", float("nan"))
        return (
            f"StereoRig of {self.left.camera_name!r} and {self.right.camera_name!r}: {len(self.pairs)} pairs "
            f"of views, rms {self.rmse_px:.4g} px\n"
            f"  baseline {self.baseline:.6g} +- {std:.2g} {self.unit}; see .left, .right and .summary()"
        )

    @property
    def lean(self) -> StereoRig:
        """Both cameras and their relative pose, without the data behind them."""
        return replace(
            self,
            left=self.left.lean,
            right=self.right.lean,
            pairs=(),
            left_out={},
            judgement=self.verdict,
        )

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
        both = [*self.pairs, *self.left_out]
        return (
            tuple(name for name in self.left.views if name not in {a for a, _ in both}),
            tuple(name for name in self.right.views if name not in {b for _, b in both}),
        )

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
    def sigma(self) -> float:
        """Standard deviation of the pixels of the calibration, in u and in v [px]."""
        return self.rmse_px / float(np.sqrt(2.0))

    @property
    def unit(self) -> str:
        """Unit of the world coordinates."""
        return self.left.unit
