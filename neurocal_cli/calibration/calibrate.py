"""`calibrate`: check what is given and asked for, solve it, and refuse results that cannot be right.

The package's docstring lists the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Literal, TypedDict, get_args

import numpy as np

from neurocal_cli.adjustment.observability import SINGULAR
from neurocal_cli.adjustment.problem import Problem, problem_for
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.calibration.calibration import Calibration, Rejected, undistorted_before
from neurocal_cli.calibration.fit import fit, shows_skew
from neurocal_cli.calibration.result import calibration_of, with_given_covariance
from neurocal_cli.calibration.verdict.findings import MISFIT, pixel_spread
from neurocal_cli.calibration.verdict.odd_points import images_without_names, repeated_views
from neurocal_cli.calibration.verdict.rules import assess
from neurocal_cli.camera.camera import Camera, camera_of
from neurocal_cli.camera.directions import WITH_XI
from neurocal_cli.camera.distortion import MODELS, Distortion, Model
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import DegenerateGeometryError, UsageError, check_seed
from neurocal_cli.network.options import STARTS, Options, Progress, options_for
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target, TargetChoice

if TYPE_CHECKING:
    from neurocal_cli.network.backprop import BackpropOptions

Method = Literal["neuro", "linear", "nonlinear", "tsai"]
Trainer = Literal["lm", "backprop"]
Lens = Literal["auto", "plumb-line"] | Model
Outliers = Literal["reject", "keep"]
Skew = Literal["free", "fixed", "auto"]


class CameraOptions(TypedDict, total=False):
    """The arguments of `calibrate` that rigs take for each of their cameras."""

    type: int
    image_center: tuple[float, float] | None
    intrinsics: Camera | Calibration | Intrinsics | Array | None
    extrinsics: Mapping[str, Pose] | Calibration | None
    method: Method
    trainer: Trainer
    distortion: Lens
    skew: bool | Skew
    outliers: Outliers
    seed: int
    target: TargetChoice | Target
    preferred: Model | Literal[""]
    fix: Mapping[str, float] | None
    square_pixels: bool
    starts: int
    backprop: BackpropOptions | None


METHODS = get_args(Method)
TRAINERS = get_args(Trainer)
DISTORTIONS = ("auto", *MODELS, "plumb-line")
OUTLIERS = get_args(Outliers)

_FOUND = ("auto", "plumb-line")  # ways to find a distortion model, not models
_NOT_FOUND = (
    "the target stays as given: either another shape does not predict the points of other views better, or "
    "these points do not determine it, which needs three different views of most points and offsets below "
    "10 % of the target's size"
)


def calibrate(
    points: Correspondences,
    type: int = 1,
    image_center: tuple[float, float] | None = None,
    intrinsics: Camera | Calibration | Intrinsics | Array | None = None,
    extrinsics: Mapping[str, Pose] | Calibration | None = None,
    method: Method = "neuro",
    trainer: Trainer = "lm",
    distortion: Lens = "auto",
    skew: bool | Skew = True,
    outliers: Outliers = "reject",
    seed: int = 0,
    *,
    target: TargetChoice | Target = "auto",
    preferred: Model | Literal[""] = "",
    start: Calibration | None = None,
    fix: Mapping[str, float] | None = None,
    square_pixels: bool = False,
    starts: int = STARTS,
    backprop: BackpropOptions | None = None,
    camera_name: str = "camera",
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate a camera from known points, from random weights.

    Parameters
    ----------
    points : Correspondences
        One view of a target that is not flat, or several views of any target.
    type : {1, 2, 3, 4}
        What is given (paper, section 4.1): 1 nothing, 2 the image centre, 3 the intrinsics,
        4 the extrinsics.
    image_center : (u0, v0), optional [px]
        For type 2. Default: that of the points, else the middle of their image size.
    intrinsics : Camera, Calibration, Intrinsics or (3, 3) array, optional
        For type 3. A Camera or Calibration includes its distortion. The standard deviations of the poses
        include the covariance of a Calibration; any other camera is taken as exact.
    extrinsics : dict of Pose by view name or Calibration, optional
        For type 4. Of a Calibration, the poses of its views.
    method : {"neuro", "linear", "nonlinear", "tsai"}
        The network, or one of the methods that the paper compares it with (`other_methods`). These use all
        points, including outliers, and have no random starts.
    trainer : {"lm", "backprop"}
    distortion : {"auto", "plumb-line"} or one of `camera.distortion.MODELS`
        The distortion model whose coefficients are estimated with all other parameters. "auto" selects the
        simplest model that the points support (`lens_choice`); with the methods linear and nonlinear it is
        none, with tsai k1. "plumb-line", the paper's way, estimates k1, k2, p1 and p2 from the images of
        straight lines alone, then the pinhole camera. Type 3 uses the distortion of the given camera.
    skew : bool or {"free", "fixed", "auto"}
        False or "fixed" holds theta at pi/2; "auto" does so unless the points show that it is another angle.
    outliers : {"reject", "keep"}
        Whether points and whole views that contradict the others are left out (`outlier_rejection`).
    seed : int
        Of the random weights; the same seed gives the same result.
    target : {"auto", "given", "flat", "free"} or Target
        How the target's points are treated: "given" uses them as given; "free" estimates them with the
        camera; "flat" does so within their plane; "auto" does so if the data support it (`target_choice`). A
        Target that is known already is used as it is. Points with stated standard deviations (`world_std`)
        are adjusted within these, unless "given".
    preferred : str
        With ``distortion="auto"``, a model to select unless another predicts decidedly better, such as that
        of the other camera of a rig.
    start : Calibration, optional
        Of the same points on another target: it starts there, instead of from random weights, if the same
        parameters are given. Its lens and its outliers are judged again. Not of several boards in one image.
    fix : dict of float by name, optional
        Parameters that are known, and stay as they are: alpha_u, alpha_v, u0, v0 [px], and coefficients of a
        named distortion model.
    square_pixels : bool
        Whether alpha_v is alpha_u, and theta pi/2, as in nearly all digital cameras.
    starts : int
        Most random starts for each network, at least 2.
    backprop : BackpropOptions, optional
        Rates and epochs of the backprop trainer.
    camera_name : str
    progress : callable, optional
        Called with the name of a stage and the completed share of it.

    Returns
    -------
    Calibration
        `converged` is False if training ended before it converged; the result is complete all the same.

    Raises
    ------
    UsageError
        A parameter that the type needs is missing, or an option does not exist.
    InputError, DegenerateGeometryError
        The points do not determine the camera; the message says why.
    """
    asked: CameraOptions = {
        "type": type, "image_center": image_center, "intrinsics": intrinsics, "extrinsics": extrinsics,
        "method": method, "trainer": trainer, "distortion": distortion, "skew": skew, "outliers": outliers,
        "seed": seed, "target": target, "preferred": preferred, "fix": fix, "square_pixels": square_pixels,
        "starts": starts, "backprop": backprop,
    }  # fmt: skip
    if points.image is not None:
        if start is not None:
            raise UsageError("start needs one board in each image, but some have several; leave it out")
        return _of_several_boards(points, asked, camera_name, progress)
    _check(asked, start)
    if isinstance(target, Target):
        if target.bends is not None:  # cameras of a rig share the same target
            target = replace(target, bends=None)
        points, asked = target.applied(points), {**asked, "target": target}
    try:
        found = _calibrated(points, asked, start, camera_name, progress)
        _refuse_misfit(found)
    except DegenerateGeometryError as error:
        explained = _explained(error, points, type)
        if explained == str(error):
            raise
        raise DegenerateGeometryError(explained) from error
    if isinstance(intrinsics, Calibration):
        found = with_given_covariance(found, intrinsics)
    undone = () if intrinsics is None else undistorted_before(points, intrinsics)
    return replace(found, warnings=(*found.warnings, *undone), judgement=assess)


def _calibrated(
    points: Correspondences,
    asked: CameraOptions,
    start: Calibration | None,
    camera_name: str,
    progress: Progress | None,
) -> Calibration:
    """The calibration that is asked for, of points on the target that is known, if one is."""
    method, target, poses = asked["method"], asked["target"], asked["extrinsics"]
    angle = _angle_of(asked)
    given = None if asked["intrinsics"] is None else camera_of(asked["intrinsics"])
    if isinstance(poses, Calibration):
        poses = {name: view.pose for name, view in poses.views.items()}
    model, way = _lens_of(asked["type"], method, asked["distortion"], given)

    def stated(with_skew: bool) -> Problem:
        known = None if given is None else given.intrinsics
        return problem_for(
            points, asked["type"], asked["image_center"], known, poses, with_skew, model, asked["fix"],
            asked["square_pixels"],
        )  # fmt: skip

    if method != "neuro":
        from neurocal_cli.calibration.other_methods.calibrate_by import calibrate_by

        found = calibrate_by(method, stated(angle == "free"), camera_name)
        unused = _unused(points, f"the method is {method}")
    else:
        options = options_for(
            asked["trainer"], asked["starts"], asked["seed"], distortion=way, preferred=asked["preferred"],
            backprop=asked["backprop"], progress=progress,
        )  # fmt: skip
        choice = "given" if isinstance(target, Target) else target
        solution, rejected = _solved(stated, angle, options, asked["outliers"], choice, start)
        if isinstance(target, Target):
            solution = solution.noted(target=target)
        found = calibration_of(
            solution, rejected, trainer=asked["trainer"], method=method, seed=asked["seed"], name=camera_name
        )
        unused = _about_target(found, choice)
    return replace(found, warnings=(*found.warnings, *unused))


def _of_several_boards(
    points: Correspondences, asked: CameraOptions, camera_name: str, progress: Progress | None
) -> Calibration:
    """Calibrate from images of several boards, which may be fixed to each other."""
    from neurocal_cli.calibration.arranged_boards import arranged

    def fitted(some: Mapping[str, Correspondences], target: TargetChoice | Target) -> Calibration:
        again: CameraOptions = {**asked, "target": target}
        return calibrate(some[camera_name], **again, camera_name=camera_name, progress=progress)

    one = {camera_name: points}
    found, told = arranged(one, asked["target"], fitted, lambda found: {camera_name: found})
    return replace(found, warnings=(*told, *found.warnings))


def _check(asked: CameraOptions, start: Calibration | None) -> None:
    """Refuse options that do not go together."""
    method, trainer, distortion = asked["method"], asked["trainer"], asked["distortion"]
    choice = asked["target"] if isinstance(asked["target"], str) else "given"
    if asked["starts"] < 2:
        raise UsageError("starts must be a whole number of at least 2, because two starts must agree")
    check_seed(asked["seed"])
    needing = {
        "fix": asked["fix"],
        "start": start,
        "square_pixels": asked["square_pixels"],
        "skew auto": asked["skew"] == "auto",
        f"target {choice}": choice in ("flat", "free"),
        f"distortion {distortion}": distortion in ("plumb-line", "rich"),
    }
    if method != "neuro" and (named := next((name for name, given in needing.items() if given), None)):
        raise UsageError(f"{named} needs the method neuro, but the method is {method}; leave it out")
    if asked["backprop"] is not None and trainer != "backprop":
        raise UsageError(f"backprop needs the trainer backprop, but the trainer is {trainer}; leave it out")


def _explained(error: DegenerateGeometryError, points: Correspondences, type: int) -> str:
    """A refusal with its true cause, the views that are given twice, and the points' file.

    The code that raised it does not know these.
    """
    from neurocal_cli.calibration.verdict.mistakes import mistake_in_all_views
    from neurocal_cli.calibration.verdict.proportions import unlike_axes

    true = images_without_names(points) or mistake_in_all_views(points)
    true = true or (unlike_axes(points) if type in (1, 2) else None)
    text, copies = "; ".join(true or ()) or str(error), repeated_views(points)
    if copies:
        text += (
            f"; the rows of {len(copies)} of {points.n_views} views are given twice, in the view itself "
            "or in another one"
        )
    if points.lines is not None and not text.startswith(points.source):
        text = f"{points.source}: {text}"
    return text


def _angle_of(asked: CameraOptions) -> str:
    """Whether the angle of the axes is "free", "fixed", or found to be one of them ("auto")."""
    skew = asked["skew"]
    if not asked["square_pixels"]:
        angle = "auto" if skew == "auto" else "free" if skew in (True, "free") else "fixed"
        if "alpha_v" in (asked["fix"] or ()) and angle != "fixed":
            raise UsageError(
                "alpha_v can be fixed with right angles only; give skew=False (--skew fixed) as well"
            )
        return angle
    if asked["distortion"] == "plumb-line":
        raise UsageError("square_pixels does not go with the distortion plumb-line; name k1k2p1p2 instead")
    if skew in ("free", "auto"):
        raise UsageError(f"square pixels have right angles, but skew is {skew}; leave it out")
    return "fixed"


def _solved(
    stated: Callable[[bool], Problem],
    angle: str,
    options: Options,
    outliers: str,
    choice: str,
    start: Calibration | None = None,
) -> tuple[Solution, Rejected]:
    """Fit with the neural method and the chosen options. Imports are local: only what is needed is loaded."""
    problem = stated(angle == "free")
    known = None if start is None else _known(problem, options, start)
    if outliers == "reject":
        from neurocal_cli.calibration.outlier_rejection import fit_robustly

        solution, rejected = fit_robustly(problem, options, known)
    else:
        solution, rejected = fit(problem, options, known and known[0]), Rejected()
    if choice != "given":
        from neurocal_cli.calibration.rich_choice import with_rich_lens
        from neurocal_cli.calibration.target_choice import with_target

        solution, rejected = with_target(problem, solution, rejected, options, choice)
        solution, rejected = with_rich_lens(problem, solution, rejected, options, choice)
    if options.distortion == "auto" and not solution.covariance.smallest > SINGULAR:
        from neurocal_cli.calibration.lens_choice.model_selection import select_model

        # To find outliers, the lens that follows the points best served, determined or not.
        solution = select_model(solution, determined=True)
    if solution.state.model in WITH_XI:
        from neurocal_cli.calibration.lens_choice.xi_profile import with_all_minima

        solution = with_all_minima(solution)
    if angle == "auto" and problem.free_camera.any() and shows_skew(solution):
        return _solved(stated, "free", options, outliers, choice)
    return solution, rejected


def _known(problem: Problem, options: Options, start: Calibration) -> tuple[Solution, Rejected] | None:
    """The solution and the outliers of a calibration to start from; None if something else was given then.

    Raises `UsageError` if it has other views.
    """
    from neurocal_cli.calibration.target_choice import solution_of

    made = isinstance(start, Calibration) and start.network is not None
    if not made or set(problem.points.view_names) - set(start.views) - set(start.rejected.views):
        raise UsageError("start must be a calibration of these points by the method neuro; leave it out")
    solution = solution_of(start)
    before, given = solution.problem, ~problem.free
    same = problem.type == before.type and problem.type in (1, 2) and problem.square == before.square
    same &= problem.held == before.held and np.array_equal(problem.free, before.free)
    same &= np.allclose(problem.entries[given], before.entries[given])
    if options.distortion != "auto":
        same &= problem.distortion.model == before.distortion.model
    n = len(before.points) + len(start.rejected)
    rejected = start.rejected if start.rejected.rows is not None and n == len(problem.points) else Rejected()
    return (solution, rejected) if same else None


def fit_poses(points: Correspondences, camera: Camera | Calibration | Intrinsics, seed: int) -> Calibration:
    """Estimate the poses of a given camera's views (type 3) from all points, without outlier rejection.

    Raises InputError or DegenerateGeometryError if the points do not determine the poses.
    """
    given = camera_of(camera)
    problem = problem_for(points, 3, intrinsics=given.intrinsics, distortion=given.distortion)
    solution = fit(problem, options_for("lm", seed=seed))
    found = calibration_of(solution, Rejected(), trainer="lm", method="neuro", seed=seed, name="camera")
    return with_given_covariance(found, camera) if isinstance(camera, Calibration) else found


def _lens_of(type: int, method: str, distortion: str, given: Camera | None) -> tuple[Distortion, str]:
    """The distortion that the problem states, and "auto" or "plumb-line" if its model is to be found."""
    if isinstance(type, (int, np.integer)) and type == 3:
        known = given.distortion if given else Distortion()
        if distortion not in ("auto", "none", known.model):
            raise UsageError(
                f"type 3 uses the distortion of the given camera ({known.model}), not {distortion}; "
                "leave it out"
            )
        return known, ""
    if method != "neuro" and distortion == "auto":
        distortion = "k1" if method == "tsai" else "none"
    return (Distortion(), distortion) if distortion in _FOUND else (Distortion(distortion), "")


def _about_target(found: Calibration, choice: str) -> tuple[str, ...]:
    """Warnings about a target that stays as given."""
    if found.target is not None:
        return ()
    if choice in ("flat", "free"):
        return (_NOT_FOUND,)
    given = choice == "given"
    why = "the target is given" if given else "the points and views are too many, or too few"
    return _unused(found.points, why)


def _unused(points: Correspondences, why: str) -> tuple[str, ...]:
    """Warn that the points' standard deviations are not used."""
    if points.world_std is None:
        return ()
    return (f"the points' standard deviations sX,sY,sZ are not used, because {why}",)


def _refuse_misfit(calibration: Calibration) -> None:
    """Refuse a camera that does not fit its points at all."""
    if calibration.rmse_px < MISFIT * pixel_spread(calibration.points):
        return
    given = {3: ", and the intrinsics", 4: ", and the poses"}.get(calibration.type, "")
    raise DegenerateGeometryError(
        f"no camera fits these points: the error of the best one is {calibration.rmse_px:.3g} px rms; "
        f"check that each pixel belongs to its point, the order and the signs of X,Y,Z and u,v{given}"
    )
