"""A calibration, its errors on points and on planes, and the target it found, as text, tables and JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from neurocal_cli.calibration.calibration import Calibration, Verdict, fixed_intrinsics
from neurocal_cli.camera import rich_lens
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.commands.show.text import (
    UNITS,
    Report,
    Table,
    align,
    align_views,
    attributes,
    joined,
    labelled,
    outcome_json,
    parameters,
    parameters_json,
    rounded,
    verdict_json,
    verdict_lines,
    with_std,
)
from neurocal_cli.errors import one_line, plural
from neurocal_cli.observations.target import Target, scale_of

if TYPE_CHECKING:
    from neurocal_cli.calibration.evaluation import CameraEvaluation
    from neurocal_cli.camera.measured import CameraPosition, PlaneErrors, Spread

_LEAST_STRETCH = 1e-6  # that is told of a bent target; less is rounding
_TIED = 1.009  # ratio of cross-validation errors that the choice of the model takes for equal
_GIVEN = {
    1: "nothing given",
    2: "image centre given",
    3: "intrinsic parameters given",
    4: "extrinsic parameters given",
}


def calibration_report(calibration: Calibration) -> str:
    """Summary of a calibration: parameters, views, fit, training and verdict, without the warnings."""
    size, points = calibration.image_size, calibration.points
    given = _GIVEN[calibration.type]
    if fixed := fixed_intrinsics(calibration):
        given += f"{' but' if calibration.type == 1 else ', and'} {', '.join(fixed)}"
    if calibration.square_pixels:
        given += ", square pixels"
    headline = (
        f"{one_line(calibration.camera_name)}: type {calibration.type} ({given}), "
        f"{plural(len(points), 'point')} in {plural(len(calibration.views), 'view')}, "
        f"{'image size unknown' if size is None else f'{size[0]} x {size[1]} px'}"
    )
    views = [
        (view.rmse_px, [one_line(name), str(view.n_points), _pixels(view.rmse_px)])
        for name, view in calibration.views.items()
    ]
    fit = [*_training_lines(calibration), *target_lines(calibration.target, calibration.unit)]
    if points.distances:
        held = plural(len(points.distances), "measured distance")
        fit.append(f"scale: held by {held}, std {100 * scale_of(points).std:.2g} %")
    return joined(
        [headline],
        align(parameter_rows(calibration)),
        align_views(["view", "points", "rms [px]"], views, "views"),
        fit,
        verdict_lines(calibration.verdict),
    )


def parameter_rows(calibration: Calibration) -> Table:
    """Rows of the intrinsic parameters, and of pose and position if there is only one view."""
    rows = [["parameter", "value", "std", "relative"]]
    for name, value in parameters(calibration).items():
        if name not in rich_lens.NAMES:
            given = name in calibration.fixed
            rows.append(_parameter_row(name, UNITS.get(name, ""), value, calibration.std[name], given))
    if calibration.distortion_model == "rich":
        rows.append(_displacement_row(calibration))
    if len(calibration.views) == 1:
        ((label, view),) = calibration.views.items()
        for name, value in view.pose.values.items():
            unit = "rad" if name.startswith("R") else one_line(calibration.unit)
            rows.append(_parameter_row(name, unit, value, view.std[name], view.fixed))
        if not view.fixed and len(calibration.points):
            for name, value, std in _position(calibration, label):
                own = labelled(f"camera's {name}", one_line(calibration.unit))
                rows.append([own, *rounded(value, std), ""])
    return rows


def _position(calibration: Calibration, view: str) -> list[tuple[str, float, float]]:
    """X, Y and Z of the camera in the world, with their std."""
    found = calibration.position(view)
    if found.covariance is None:
        return []
    return list(zip("XYZ", found.point.tolist(), found.std.tolist(), strict=True))


def _parameter_row(name: str, unit: str, value: float, std: float, given: bool) -> list[str]:
    label = labelled(name, unit)
    if given:
        return [label, f"{value:.7g}", "fixed", ""]
    share = 100 * std / abs(value) if value != 0 else math.inf
    relative = f"{share:.2g} %" if share < 99.5 else f"{share:.0f} %"
    return [label, *rounded(value, std), relative if math.isfinite(share) else "-"]


def _displacement_row(calibration: Calibration) -> list[str]:
    """One row for all nodes of a rich lens: their largest displacement at the observed points [px]."""
    rays = calibration.camera.unproject(calibration.points.pixels)
    k = calibration.distortion[-len(rich_lens.NAMES) :]
    X, Y, Z = rays[np.isfinite(rays[:, 0])].T
    d = rich_lens.displacement(k, X, Y, Z, by_coefficients=False)
    moved = np.hypot(calibration.intrinsics.alpha_u * d.x, calibration.intrinsics.alpha_v * d.y)
    return ["displacement [px]", f"up to {moved.max(initial=0.0):.2g}", f"{len(rich_lens.NODES)} nodes", ""]


def _training_lines(calibration: Calibration) -> list[str]:
    """The error, and how the calibration came to it."""
    rejected = f", {plural(calibration.n_rejected, 'outlier')} rejected" if calibration.n_rejected else ""
    lines = [
        f"reprojection error: rms {_pixels(calibration.rmse_px)} px, "
        f"maximum {_pixels(calibration.max_px)} px{rejected}"
    ]
    if (found := calibration.straight_lines) is not None:
        u, v = found.centre
        lines.append(
            f"straight lines: {plural(found.n_points, 'point')} on {plural(found.n_lines, 'line')}, rms "
            f"distance {_pixels(found.rms_before)} px before undistortion, {_pixels(found.rms_after)} px "
            f"after; centre of distortion ({u:.1f}, {v:.1f})"
        )
    if (network := calibration.network) is not None:
        starts, views = plural(network.starts, "random start"), len(network.V)
        agreed = (
            f"networks: {starts} for {views} views, at least {network.agreed} agreed in each view"
            if views > 1
            else f"network: {network.agreed} of {starts} agreed"
        )
        lines += [
            f"{agreed}, {plural(network.iterations, 'iteration')}, loss {_pixels(network.loss)} px",
            f"bundle adjustment: rms {_pixels(network.rmse_before)} px before, "
            f"{_pixels(network.rmse_after)} px after {plural(network.refine_iterations, 'iteration')}",
        ]
    if choice := calibration.lens_choice:  # the candidates with their cross-validation errors, best first
        errors = [f"{name} {_pixels(error)}" for name, error in sorted(choice.items(), key=itemgetter(1))]
        how = f"chosen by error and number of coefficients{_among(calibration)}"
        lines += [
            f"distortion model: {calibration.distortion_model}, {how}:",
            f"  {', '.join(errors)} px",
        ]
    return [*lines, calibration.stop_reason]


def _among(calibration: Calibration) -> str:
    """From which models the distortion model was chosen, if one that was excluded has a lower error."""
    choice, chosen = calibration.lens_choice, calibration.distortion_model
    error = choice.get(chosen, 0.0)
    if chosen not in WIDE and any(name in WIDE and other < error for name, other in choice.items()):
        return " among ordinary lenses, because the points do not decidedly favour a fisheye"
    if error > _TIED * min(choice.values()):
        return " among the models that the points support"
    return ""


def calibration_json(calibration: Calibration) -> dict[str, Any]:
    """Convert the summary of a calibration to JSON values; numbers that are not finite become None."""
    return {
        **attributes(calibration, "camera_name image_size"),
        "n_points": len(calibration.points),
        **attributes(calibration, "n_rejected unit type method distortion=distortion_model"),
        "parameters": parameters_json(calibration),
        **attributes(calibration, "rmse_px max_px"),
        "views": {name: view.rmse_px for name, view in calibration.views.items()},
        "second_poses": {
            name: [
                attributes(one, "probability") | attributes(one.pose, "R t")
                for one in (calibration.views[name], second)
            ]
            for name, second in calibration.second_poses.items()
        },
        "lens_choice": calibration.lens_choice,
        "positions": _positions_json(calibration),
        "target": target_json(calibration.target, calibration.unit),
        **outcome_json(calibration),
    }


def _positions_json(calibration: Calibration) -> dict[str, Any]:
    """Of a single view: the position of the camera in the world, with its std."""
    if len(calibration.views) != 1 or not len(calibration.points):
        return {}
    (view,) = calibration.views
    places = _position(calibration, view)
    return {view: {name: {"value": value, "std": std} for name, value, std in places}}


def target_lines(target: Target | None, unit: str) -> list[str]:
    """The estimated target in one or two lines; none if it was used as given."""
    if target is None:
        return []
    unit = "units" if unit == "unknown" else one_line(unit)
    found = np.sqrt((target.offsets**2).sum(axis=1).mean())
    if target.stated is not None:
        held = int((target.stated == 0).all(axis=1).sum())
        exact = f"; {plural(held, 'point')} of {len(target.found)} held" if held else ""
        factor = target.sizes["stated"]
        taken = "" if factor == 1 else f", scaled by {factor:.2g} to match the residuals"
        return [
            f"surveyed points: found {found:.2g} {unit} rms from where they were stated, by their stated "
            f"standard deviations{taken}{exact}"
        ]
    lines = []
    if not target.only_bends:
        in_planes = target.has_planes
        parts = [f"bent by {target.bend():.2g} {unit}"] if in_planes and not target.flat else []
        if in_planes and (target.flat or target.stretch() > _LEAST_STRETCH):
            parts.append(f"stretched by {100 * target.stretch():.2g} %")
        what = f"{' and '.join(parts)}; " if parts else ""
        lines.append(f"target: {what}its points lie {found:.2g} {unit} rms from where they were given")
        shift, turn = target.displaced()
        if shift or turn:
            lines.append(
                f"target: its planes are up to {shift:.2g} {unit} and {np.degrees(turn):.2g} degrees from "
                "where they were given"
            )
    if target.bends is not None:
        lines.append(f"target: bends anew in each view, by {target.bend_of_views():.2g} {unit} rms")
    return lines


def target_json(target: Target | None, unit: str) -> dict[str, Any] | None:
    """Convert the estimated target to JSON values; None if it was used as given."""
    if target is None:
        return None
    shift, turn = target.displaced()
    planes = {"planes_shift": shift, "planes_turn_deg": np.degrees(turn)}
    return {
        "unit": unit,
        "flat": target.flat,
        "bend": target.bend(),
        "stretch": target.stretch(),
        "offset_rms": np.sqrt((target.offsets**2).sum(axis=1).mean()),
        "std_rms": np.sqrt((target.std**2).mean()),
        "n_points": len(target.found),
        **(planes if target.plane.any() else {}),
        **({} if target.bends is None else {"bend_of_views_rms": target.bend_of_views()}),
        **({} if target.stated is None else {"stated_std_factor": target.sizes["stated"]}),
    }


def evaluation_report(e: CameraEvaluation, verdict: Verdict | None, since: Report) -> Report:
    """An evaluation, with the verdict and what the points say of the calibration since it was made."""
    overall = [
        ["[px]", "rms", "bias", "max"],
        ["u", _pixels(e.rms_u), _bias(e.bias_u, e.rms_u), ""],
        ["v", _pixels(e.rms_v), _bias(e.bias_v, e.rms_v), ""],
        ["both", _pixels(e.rmse_px), "", _pixels(e.max_px)],
    ]
    views = [["view", "points", "behind", "rms [px]", "max [px]", "pose"]]
    for name, view in e.views.items():
        numbers = [str(view.n_points), str(view.n_behind), _pixels(view.rmse_px), _pixels(view.max_px)]
        views.append([one_line(name), *numbers, "fitted" if view.fitted else "calibrated"])
    tree = {
        **attributes(e, "n_points n_behind rmse_px max_px rms_u rms_v bias_u bias_v"),
        "views": {name: view.rmse_px for name, view in e.views.items()},
        **attributes(e, "fitted_views"),
        **verdict_json(verdict),
        **since.tree,
    }
    return Report(tree, [overall, views], [*since.below, *verdict_lines(verdict)])


def _decimals(value: float) -> int | None:
    """Decimals of a pixel error with about four significant digits; None if it needs an exponent."""
    if value != 0 and abs(value) < 1e-4:
        return None
    return max(0, 5 - len(str(int(abs(value)))))


def _pixels(value: float) -> str:
    """Format a pixel error with about four significant digits; only tiny errors have an exponent."""
    if not math.isfinite(value):
        return "-"
    decimals = _decimals(value)
    return f"{value:.1e}" if decimals is None else f"{value:.{decimals}f}"


def _bias(value: float, rms: float) -> str:
    """Format a mean residual with the decimals of the rms error of the same axis."""
    if not (math.isfinite(value) and math.isfinite(rms)):
        return "-"
    decimals = _decimals(rms)
    if decimals is None:
        return f"{value:+.1e}"
    return f"{round(value, decimals) + 0.0:+.{decimals}f}"  # + 0.0 avoids -0


def plane_report(errors: PlaneErrors | None, unit: str) -> Report:
    """A length and points on a plane, with the shares of calibration and pixels; nothing without errors."""
    if errors is None:
        return Report()
    unit = one_line(unit)
    rows = [[f"at {errors.distance:g} {unit}", f"std [{unit}]", "of calibration", "of pixels"]]
    for what, spread in (
        (f"a length of {errors.length:.4g} {unit}", errors.of_length),
        ("a point in the middle", errors.of_middle),
        ("its depth", errors.of_depth),
        ("the least certain point", errors.of_worst),
    ):
        if spread is None:
            continue
        told = spread.std, spread.by_calibration, spread.by_pixel
        rows.append([what, *(rounded(std, std)[0] for std in told)])

    def shares(spread: Spread) -> dict[str, float]:
        return attributes(spread, "std calibration=by_calibration pixels=by_pixel")

    at = {
        **attributes(errors, "distance sigma_px=sigma"),
        "length": {"length": errors.length, **shares(errors.of_length)},
        "middle": shares(errors.of_middle),
        **({} if errors.of_depth is None else {"depth": shares(errors.of_depth)}),
        "worst": shares(errors.of_worst),
    }
    return Report({"at": at}, [rows])


def position_report(positions: Mapping[str, CameraPosition], unit: str) -> Report:
    """Where the camera was in each view; no table without views."""
    rows = [["camera in", *(f"{axis} [{one_line(unit)}]" for axis in "XYZ")]]
    for name, place in positions.items():
        pairs = zip(place.point.tolist(), place.std.tolist(), strict=True)
        cells = [with_std(value, std) if std > 0 else f"{value:.7g}" for value, std in pairs]
        rows.append([one_line(name), *cells])
    tree = {name: attributes(place, "point std covariance") for name, place in positions.items()}
    return Report({"positions": tree}, [rows] if positions else [])
