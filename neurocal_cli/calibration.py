"""What a calibration returns: the camera, the poses, how sure they are and how they were found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences

__all__ = ["Calibration", "NetworkRecord", "Rejected", "StopReason", "StraightLines", "Verdict", "ViewResult"]


class StopReason(str, Enum):
    """Why training stopped; the value is the sentence to show."""

    CONVERGED = "converged: the pixel error cannot be lowered further"
    MAX_ITERATIONS = "stopped at the limit of iterations before the pixel error settled"
    NO_AGREEMENT = "the starts were spent before two of them agreed"


@dataclass(frozen=True, eq=False)
class NetworkRecord:
    """What the training did, kept with the result.

    Attributes
    ----------
    W : (3, 3) array
        Output weights, ``A = S1 W``, ``W[2, 2] = 1``.
    V : dict of (3, 4) arrays by view
        Hidden weights; ``[R | t] = s2 V S2`` up to the scale that gamma leaves free.
    S1 : (3, 3) array
        Normalised to real pixels.
    S2 : dict of (4, 4) arrays by view
        Real to normalised world coordinates; ``P = S1 W V S2`` up to scale.
    starts, agreed : int
        Random starts used, over all views; how many of them ended at the result they agreed on.
    iterations : int
        Training iterations (epochs for backprop) of the network, summed over the starts.
    refine_iterations : int
        Iterations of the last step on the true pixel error (3).
    loss : float
        Root mean square of the network's error (5) after training [px].
    rmse_before, rmse_after : float
        Pixel error (3) before and after the last step [px].
    curve : tuple of float
        Learning curve: loss of the network [px rms] along the training of the best start.
    """

    W: Array
    V: Mapping[str, Array]
    S1: Array
    S2: Mapping[str, Array]
    starts: int
    agreed: int
    iterations: int
    refine_iterations: int
    loss: float
    rmse_before: float
    rmse_after: float
    curve: tuple[float, ...] = ()


@dataclass(frozen=True)
class StraightLines:
    """What a lens was found from, where it was found from straight lines alone.

    Attributes
    ----------
    n_lines, n_points : int
        Lines, counted in each view that shows them, and points on them.
    centre : (u, v) [px]
        Of distortion.
    rms_before, rms_after : float [px]
        Distance of the points from straight lines as seen, and seen through the lens.
    """

    n_lines: int
    n_points: int
    centre: tuple[float, float]
    rms_before: float
    rms_after: float


@dataclass(frozen=True, eq=False)
class ViewResult:
    """One view's pose.

    Attributes
    ----------
    pose : Pose
    std : dict
        Standard deviation of R_x, R_y, R_z [rad], t_x, t_y, t_z [world unit]; 0 for a given pose.
    n_points : int
    rmse_px : float [px]
    fixed : bool
        Whether the pose was given.
    """

    pose: Pose
    std: Mapping[str, float]
    n_points: int
    rmse_px: float
    fixed: bool = False


@dataclass(frozen=True, eq=False)
class Rejected:
    """Points that were set aside because they contradict the others.

    Attributes
    ----------
    points : Correspondences or None
        With their lines in the file; None when there are none.
    error_px : (M,) array [px]
        How far each is from where the camera sees it; nan where it does not, and in views that were set
        aside whole.
    views : dict of str by view name
        Views that were set aside whole, each with the reason.
    """

    points: Correspondences | None = None
    error_px: Array = field(default_factory=lambda: np.zeros(0))
    views: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.error_px)


@dataclass(frozen=True)
class Verdict:
    """One word on a calibration, and why.

    Attributes
    ----------
    word : str
        "good", "usable" or "poor".
    reasons : tuple of str
        What speaks against it, the worst first; none when it is good.
    advice : tuple of str
        What to do next.
    measures : dict of float
        What it rests on (`verdict.evidence.Evidence`); nan for what cannot be told.
    """

    word: str
    reasons: tuple[str, ...]
    advice: tuple[str, ...]
    measures: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated camera.

    Attributes
    ----------
    intrinsics : Intrinsics
    std : dict
        Standard deviation of alpha_u, alpha_v, u0, v0 [px] and theta [rad]; 0 for given ones.
    fixed : frozenset of str
        Names of the intrinsic parameters that were given.
    views : dict of ViewResult by view name
    points : Correspondences
        What it was calibrated from, without what was rejected.
    rejected : Rejected
    verdict : Verdict or None
        Of `verdict.assessment.judged`; None before it.
    lens_choice : dict of float by lens model [px]
        The models that ``distortion="auto"`` chose from and their rms error on data left out.
    covariance : (n, n) array
        Of the free intrinsic parameters, in the order of `covariance_names`; per-view blocks are
        in `views`.
    warnings : tuple of str
        What the user should know; printed by the command.
    """

    intrinsics: Intrinsics
    std: Mapping[str, float]
    fixed: frozenset[str]
    views: Mapping[str, ViewResult]
    points: Correspondences
    type: int
    method: str
    trainer: str
    seed: int
    converged: bool
    stop_reason: str
    rmse_px: float
    max_px: float
    distortion_model: str = "none"
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    covariance_names: tuple[str, ...] = ()
    network: NetworkRecord | None = None
    straight_lines: StraightLines | None = None
    camera_name: str = "camera"
    warnings: tuple[str, ...] = ()
    rejected: Rejected = field(default_factory=Rejected)
    lens_choice: Mapping[str, float] = field(default_factory=dict)
    verdict: Verdict | None = None

    @property
    def n_rejected(self) -> int:
        """Points that were set aside."""
        return len(self.rejected)

    @property
    def K(self) -> Array:
        """(3, 3) camera matrix A, skew included."""
        return self.intrinsics.A

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(width, height) [px], if known."""
        return self.points.image_size

    @property
    def unit(self) -> str:
        """Unit of the world coordinates."""
        return self.points.unit

    @property
    def rotations(self) -> dict[str, Array]:
        """(3, 3) rotation of each view."""
        return {name: view.pose.R for name, view in self.views.items()}

    @property
    def translations(self) -> dict[str, Array]:
        """(3,) translation of each view [world unit]."""
        return {name: view.pose.t for name, view in self.views.items()}

    @property
    def projections(self) -> dict[str, Array]:
        """(3, 4) matrix P = A [R | t] of each view, paper eq. (1)."""
        return {name: self.K @ view.pose.D for name, view in self.views.items()}
