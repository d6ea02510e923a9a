"""`Calibration`, the result: the camera, the poses, their standard deviations and how they were estimated."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import field, replace
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.presented import Presented
from neurocal_cli.camera.camera import Camera, camera_of
from neurocal_cli.camera.directions import WITH_XI
from neurocal_cli.camera.distortion import Distortion, StraightLines, coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.late_import import late
from neurocal_cli.camera.measured import CameraPosition, PlaneErrors, PlanePoints, ProjectedPoints
from neurocal_cli.camera.opencv_names import camera_info, opencv_coefficients
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, Intrinsics, Pose
from neurocal_cli.camera.projection import ENTRY_NAMES
from neurocal_cli.camera.rich_lens import NODES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import InputError
from neurocal_cli.observations.measured_directions import equations
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target

_MOST_SHOWN = 5  # coefficients, on a line


class StopReason(str, Enum):
    """Why the estimation stopped; the value is the text shown to the user."""

    CONVERGED = "converged: the reprojection error is at a minimum"
    MAX_ITERATIONS = "stopped at the maximum number of iterations before the reprojection error settled"
    NO_AGREEMENT = "no two of the random starts agreed"
    NOT_MINIMISED = "solved; the method does not minimise the reprojection error"


@frozen_dataclass(eq=False)
class NetworkRecord:
    """Record of the training, kept with the result; errors and losses are in pixels."""

    W: Array  # (3, 3) output weights, ``A = S1 W``, ``W[2, 2] = 1``
    # By view, (3, 4) hidden weights; ``[R | t] = s2 V S2`` up to the scale that gamma leaves free.
    V: Mapping[str, Array]
    S1: Array  # (3, 3) from normalised to real pixels
    S2: Mapping[str, Array]  # by view, (4, 4) from real to normalised world; ``P = S1 W V S2`` up to scale
    starts: int  # number of random starts over all views
    agreed: int  # least number of starts in any view that ended at its best result
    iterations: int  # of training the network (epochs for backprop), summed over the starts
    refine_iterations: int  # of bundle adjustment on the reprojection error (3)
    loss: float  # rms of the network's error (5) after training
    rmse_before: float  # reprojection error (3) before bundle adjustment
    rmse_after: float
    curve: tuple[float, ...] = ()  # learning curve: loss along the training of the best start


@frozen_dataclass(eq=False)
class ViewResult:
    """One view's pose."""

    pose: Pose
    std: Mapping[str, float]  # of R_x, R_y, R_z [rad], t_x, t_y, t_z [world unit]; 0 for a given pose
    n_points: int
    rmse_px: float
    fixed: bool = False  # whether the pose was given
    # Less than 1 if the flat target has a second pose that noise may have made the worse one.
    probability: float = 1.0


@frozen_dataclass(eq=False)
class Rejected:
    """Outliers: points and views that were left out because they contradict the others."""

    points: Correspondences | None = None  # with their lines in the file; None if there are none
    # (M,) reprojection error of each point; nan where it has none, and in views left out as a whole.
    error_px: Array = field(default_factory=lambda: np.zeros(0))
    # Those that were left out as a whole, each with the reason.
    views: Mapping[str, str] = field(default_factory=dict)
    # (M,) places among all points that were given; none if they are not known.
    rows: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))

    def __len__(self) -> int:
        return len(self.error_px)


@frozen_dataclass
class Verdict:
    """Verdict on a calibration: one word, with reasons and advice."""

    word: str  # "good", "usable" or "poor"
    reasons: tuple[str, ...]  # what is wrong, the worst first; empty for a good calibration
    advice: tuple[str, ...]  # what to do about it
    # The measures behind it (`calibration.verdict.evidence.Evidence`); nan if not determined.
    measures: Mapping[str, float]


@frozen_dataclass(eq=False)
class Calibration(Presented):
    """A calibrated camera.

    Attributes
    ----------
    intrinsics : Intrinsics
    std : dict
        Standard deviation of alpha_u, alpha_v, u0, v0 [px] and theta [rad]; 0 for given ones.
    fixed : frozenset of str
        Names of the intrinsic parameters that were given.
    square_pixels : bool
        Whether alpha_v was bound to alpha_u, which is then one unknown for both.
    views : dict of ViewResult by view name
    points : Correspondences
        The points it was calibrated from, without outliers. If the target was estimated with the camera,
        their world coordinates are the estimated ones.
    rejected : Rejected
    target : Target or None
        The estimated target; None if it was used as given.
    second_poses : dict of ViewResult by view name
        Poses of flat targets that fit nearly as well as those of `views`, tilted the other way, with their
        probability. The standard deviations of `views` cover both poses; those here are left out.
    target_stretched : float
        If the given target was selected: the probability that its print is nevertheless stretched or leans by
        a few thousandths, which the standard deviations include. 0 if it is below 0.001.
    judgement : Verdict or callable, optional
        The verdict read from a file, or the function that computes it from this calibration; see `verdict`.
    lens_choice : dict of float by distortion model [px]
        The candidate models of ``distortion="auto"`` and their cross-validation errors.
    covariance : (n, n) array
        Of the free intrinsic parameters, in the order of `covariance_names`; `views` holds the standard
        deviations of the poses.
    given_covariance : (n, n) array
        Of a given camera's parameters (type 3), in the order of `given_names`, as far as it is known. The
        standard deviations of the poses include it, and those of the given parameters themselves are 0.
    warnings : tuple of str
        Warnings, which the command prints.
    """

    intrinsics: Intrinsics
    std: Mapping[str, float]
    fixed: frozenset[str]
    views: Mapping[str, ViewResult]
    points: Correspondences
    method: str
    stop_reason: str
    type: int = 1
    trainer: str = "none"
    seed: int = 0
    converged: bool = True
    rmse_px: float = np.nan
    max_px: float = np.nan
    distortion_model: str = "none"
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    covariance_names: tuple[str, ...] = ()
    given_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    given_names: tuple[str, ...] = ()
    network: NetworkRecord | None = None
    straight_lines: StraightLines | None = None
    camera_name: str = "camera"
    warnings: tuple[str, ...] = ()
    rejected: Rejected = field(default_factory=Rejected)
    target: Target | None = None
    lens_choice: Mapping[str, float] = field(default_factory=dict)
    second_poses: Mapping[str, ViewResult] = field(default_factory=dict)
    target_stretched: float = 0.0
    square_pixels: bool = False
    judgement: Verdict | Callable[[Calibration], Verdict | None] | None = None

    _summary = ("commands.show.camera_report", "calibration_report")

    def __repr__(self) -> str:
        size = "unknown" if self.image_size is None else "{} x {} px".format(*self.image_size)
        names = ("alpha_u", "alpha_v", "u0", "v0")
        values = {name: getattr(self.intrinsics, name) for name in names}
        known = (f"{name} {value:.6g} +- {self.std.get(name, np.nan):.2g}" for name, value in values.items())
        coefficients = ", ".join(f"{k:.4g}" for k in self.distortion[:_MOST_SHOWN].tolist())
        more = ", ..." if len(self.distortion) > _MOST_SHOWN else ""
        return (
            f"Calibration of {self.camera_name!r}: {len(self.points)} points in {len(self.views)} views, "
            f"images {size}, rms {self.rmse_px:.4g} px\n"
            f"  {', '.join(known)} px, theta {np.degrees(self.intrinsics.theta):.4f} degrees\n"
            f"  distortion {self.distortion_model} [{coefficients}{more}]; see .summary()"
        )

    def project(self, points: Array, view: str | None = None) -> ProjectedPoints:
        """Project points, with the covariance that the calibration gives their pixels.

        Parameters
        ----------
        points : (N, 3) array [world unit]
            In the frame of the view's target; without a view, in the camera's own frame (x right, y down, z
            forward).
        view : str, optional
            A view of this calibration, whose pose is used, with its uncertainty.

        Returns
        -------
        ProjectedPoints
            `pixels` and `covariance`. The latter is that of points which are fixed to the target of the view,
            or without a view to the targets of all views: a change of the camera that a change of the poses
            compensates is no uncertainty. This is the std of predicted pixels of the verdict.

        Raises
        ------
        InputError
            There is no such view, or the array has another shape.
        """
        found: ProjectedPoints = late("calibration.measurement", "project")(self, points, view)
        return found

    def on_plane(self, pixels: Array, view: str, sigma: float | None = None) -> PlanePoints:
        """Convert pixels to points on the target of a view, such as millimetres on a board on a table.

        Parameters
        ----------
        pixels : (N, 2) array [px]
            Of the original images.
        view : str
            The view of this calibration whose target is the plane Z = 0.
        sigma : float, optional [px]
            Standard deviation of the pixels, in u and in v. Default: that of the calibration.

        Returns
        -------
        PlanePoints
            `points` and their `covariance`, with the shares of the calibration and of the pixels.

        Raises
        ------
        InputError
            There is no such view, or its target has no point with Z = 0.
        """
        found: PlanePoints = late("calibration.measurement", "on_plane")(self, pixels, view, sigma)
        return found

    def errors_at(self, distance: float) -> PlaneErrors:
        """How well lengths and points are measured on a plane at a distance from the camera [world unit].

        The plane faces the camera, and its distance is taken as exact. Raises InputError for a distance that
        is not positive, and without image size.
        """
        found: PlaneErrors = late("calibration.measurement", "errors_at")(self, distance)
        return found

    def position(self, view: str) -> CameraPosition:
        """Where the camera was when it saw a view, in the coordinates of the view's target.

        Its covariance includes that of the camera. Raises InputError if there is no such view.
        """
        found: CameraPosition = late("calibration.measurement", "position")(self, view)
        return found

    def pose_of(self, view: str) -> Pose:
        """The pose of a view; an InputError names those that there are."""
        if view not in self.views:
            known = list(self.views)
            some = ", ".join(known[:5]) + (", ..." if len(known) > 5 else "")
            raise InputError(f"the calibration has no view {view!r}; give one of {some}")
        return self.views[view].pose

    @property
    def sigma(self) -> float:
        """Standard deviation of the pixels of the calibration, in u and in v [px]."""
        return self.rmse_px / float(np.sqrt(2.0))

    @property
    def cv2_distortion(self) -> Array:
        """(5,), (8,), (12,) or (14,) coefficients for ``cv2.projectPoints``, ``cv2.undistort`` and so on.

        With `K`, and `rotations` and `translations` of a view. Raises InputError for a distortion model that
        OpenCV lacks, a fisheye (see `cv2_fisheye_distortion`), or a camera with skew, which OpenCV ignores.
        """
        return opencv_coefficients(self.camera)

    @property
    def cv2_fisheye_distortion(self) -> Array:
        """(4,) coefficients k1 to k4 for ``cv2.fisheye``; raises InputError for any other lens."""
        return opencv_coefficients(self.camera, fisheye=True)

    def to_ros(self) -> dict[str, Any]:
        """Fields of ROS's message: ``sensor_msgs.msg.CameraInfo(**camera.to_ros())``.

        They are width, height, distortion_model, d, k, r and p. Raises InputError for a distortion model that
        ROS lacks, a camera with skew, which ROS ignores, or images of unknown size.
        """
        return camera_info(self.camera)

    @cached_property
    def verdict(self) -> Verdict | None:
        """Verdict on this calibration, computed when it is first read; None without points of its own."""
        return self.judgement(self) if callable(self.judgement) else self.judgement

    @property
    def lean(self) -> Calibration:
        """The camera with its uncertainty and verdict, without the data behind it."""
        return replace(
            self,
            points=Correspondences.none(self.image_size, self.unit),
            views={},
            second_poses={},
            network=None,
            rejected=Rejected(),
            target=None,
            judgement=self.verdict,
        )

    @property
    def n_rejected(self) -> int:
        """Number of points that were left out."""
        return len(self.rejected)

    @property
    def camera(self) -> Camera:
        """The camera without poses and statistics."""
        distortion = Distortion(self.distortion_model, self.distortion)
        return Camera(self.intrinsics, distortion, self.image_size, self.camera_name)

    @property
    def known_covariance(self) -> tuple[tuple[str, ...], Array]:
        """Names and covariance of the parameters whose uncertainty is known, whether estimated or given."""
        if self.covariance_names:
            return self.covariance_names, self.covariance
        return self.given_names, self.given_covariance

    @property
    def std_of_given(self) -> dict[str, float]:
        """Standard deviations that given parameters have in their own calibration, as far as it is known."""
        std = np.sqrt(np.maximum(np.diagonal(self.given_covariance), 0.0)).tolist()
        return dict(zip(self.given_names, std, strict=True))

    @property
    def K(self) -> Array:
        """(3, 3) camera matrix A, skew included."""
        return self.intrinsics.A

    @property
    def relative_std_of_scale(self) -> float:
        """Relative standard deviation of the scale in the image centre, the larger of u and v.

        The scale is alpha, or alpha / (1 + xi) in models with xi.
        """
        shares = [self.std[name] / getattr(self.intrinsics, name) for name in ("alpha_u", "alpha_v")]
        if self.distortion_model in WITH_XI and {"alpha_u", "xi"} <= set(self.covariance_names):
            xi = self.covariance_names.index("xi")
            for n, name in enumerate(("alpha_u", "alpha_v")):
                gradient = np.zeros(len(self.covariance_names))
                gradient[self.covariance_names.index(name)] = 1 / getattr(self.intrinsics, name)
                gradient[xi] = -1 / (1 + self.distortion[0])
                shares[n] = float(np.sqrt(gradient @ self.covariance @ gradient))
        return max(shares)

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(width, height) [px], if known."""
        return self.points.image_size

    @property
    def unit(self) -> str:
        """Unit of the world coordinates."""
        return self.points.unit

    def state(self, names: Sequence[str]) -> CameraState:
        """The camera and its poses of the named views, in pixels and world units."""
        poses, camera = [self.views[name].pose for name in names], self.camera
        R, t = np.stack([pose.R for pose in poses]), np.stack([pose.t for pose in poses])
        lens = camera.distortion
        return CameraState(
            np.array([camera.entries]), R, t, lens.model, lens.coefficients, self.square_pixels
        )

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


def fixed_intrinsics(calibration: Calibration) -> dict[str, float]:
    """The intrinsic parameters that were given one by one, without those that the type gives, and theta."""
    of_type = {1: (), 2: ("u0", "v0"), 3: INTRINSIC_NAMES, 4: ()}[calibration.type]
    names = calibration.fixed & set(INTRINSIC_NAMES) - {"theta", *of_type}
    return {name: float(getattr(calibration.intrinsics, name)) for name in sorted(names)}


def free_entries(calibration: Calibration, held: Collection[str] = ()) -> NDArray[np.bool_]:
    """(5 + K,) which of A11, A12, A22, A13, A23 and the coefficients are unknowns, neither given nor held."""
    names = (*ENTRY_NAMES, *coefficient_names(calibration.distortion_model))
    free = np.array([name not in calibration.fixed and name not in held for name in names])
    free[2] &= not calibration.square_pixels
    return free


def estimated_parameters(calibration: Calibration) -> NDArray[np.bool_]:
    """(5 + K,) which of A's entries and the distortion coefficients the views' points alone determined.

    Coefficients from straight lines are not among them, nor a rich lens's nodes, which need their prior.
    """
    from_lines = calibration.straight_lines is not None
    names = coefficient_names(calibration.distortion_model) if from_lines else NODES
    return free_entries(calibration, names)


def spare_equations(calibration: Calibration) -> float:
    """Number of equations that the points give beyond the number of unknowns."""
    points, views = calibration.points, calibration.views.values()
    unknowns = int(estimated_parameters(calibration).sum()) + 6 * sum(not view.fixed for view in views)
    return float(equations(points.across, len(points)).sum()) - unknowns


def undistorted_before(
    points: Correspondences, given: Camera | Calibration | Intrinsics | Array
) -> tuple[str, ...]:
    """Why a camera with distortion does not belong to points that are undistorted already, if it does not.

    A camera that was calibrated from undistorted points has the distortion that these have left.
    """
    if not points.undistorted or camera_of(given).distortion.is_identity:
        return ()
    if isinstance(given, Calibration) and given.points.undistorted:
        return ()
    return (
        f"{points.source}: the points are undistorted already, so the camera's distortion "
        f"({camera_of(given).distortion.model}) is not theirs, unless the camera was calibrated from "
        "undistorted points; give the points as they were measured, or a camera without distortion",
    )
