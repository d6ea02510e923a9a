"""Pictures of cameras, rigs and triangulated points: a page of panels, or a single panel."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.calibration.rig.evaluation import StereoEvaluation
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.space_error import SpaceError
from neurocal_cli.calibration.rig.stereo_rig import StereoRig
from neurocal_cli.camera.geometry import Array
from neurocal_cli.commands.show.camera_panels import Subject, draw_poses, panels_of
from neurocal_cli.commands.show.figure import ACCENT, INK, picture, plain, style
from neurocal_cli.commands.show.rig_panels import draw_edges, targets_of_rig
from neurocal_cli.errors import plural

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PAD = 0.12  # inches
_PAGE = (15.0, 11.0)
_PANEL = (5.0, 4.0)  # text of 9 points is still read where the picture is 400 px wide
_SIDES = ("left", "right")
_ROWS = (("residuals", "coverage", "uncertainty"), ("scatter", "poses", "learning"), ("views",) * 3)

Draw = Callable[["Axes"], None]


def draw_camera(subject: Subject, kind: str = "png", panel: str | None = None) -> bytes:
    """Draw all panels of a camera, or one of `CAMERA_PANELS`; the same subject gives the same bytes."""
    panels = panels_of(subject)
    if panel is not None:
        return _alone(panel, panels[panel], kind)
    evaluation = subject.evaluation
    title = (
        f"{plain(subject.camera.name)}: rms {evaluation.rmse_px:.4g} px, max {evaluation.max_px:.4g} px, "
        f"{evaluation.n_points} points, {plural(len(evaluation.views), 'view')}"
    )
    return _page([list(row) for row in _ROWS], (1, 1, 0.55), panels, title, _PAGE, kind)


def draw_stereo(rig: StereoRig, kind: str = "png", panel: str | None = None) -> bytes:
    """Draw both cameras of a rig side by side, or one of `RIG_PANELS` for both; see `draw_camera`."""
    sides = {"left": Subject.of(rig.left), "right": Subject.of(rig.right)}
    panels: dict[str, Draw] = {
        f"{side} {name}": _with_side(side, draw)
        for side, subject in sides.items()
        for name, draw in panels_of(subject).items()
    }
    panels["poses"] = lambda axes: draw_poses(axes, rig.left, [(rig.right.camera, rig.pose)], _SIDES)
    if panel == "poses":
        return _alone(panel, panels[panel], kind)
    rows = [[f"{side} {name}" for name in _ROWS[0]] for side in sides]
    rows.append(["poses", "left views", "right views"])
    size = _PAGE
    if panel is not None:
        rows = [[f"{side} {panel}" for side in sides]]
        size = 2 * _PANEL[0], _PANEL[1]
    title = (
        f"rms {rig.rmse_px:.4g} px, max {rig.max_px:.4g} px, {len(rig.pairs)} pairs of views, baseline "
        f"{rig.baseline:.6g} {plain(rig.unit)}"
    )
    return _page(rows, (1,) * len(rows), panels, title, size, kind)


def draw_rig(rig: Rig, kind: str = "png", panel: str | None = None) -> bytes:
    """Draw the cameras of a rig with the targets of all frames in space, and what pairs see together."""
    others = [(rig.cameras[name].camera, pose) for name, pose in list(rig.poses.items())[1:]]
    panels: dict[str, Draw] = {
        "poses": lambda axes: draw_poses(
            axes, rig.cameras[rig.first], others, tuple(rig.cameras), targets_of_rig(rig)
        ),
        "edges": lambda axes: draw_edges(axes, rig),
    }
    title = f"{len(rig.cameras)} cameras, {plural(len(rig.frames), 'frame')}, rms {rig.rmse_px:.4g} px"
    return _page([list(panels)], (1,), panels, title, (2 * _PANEL[0], _PANEL[1]), kind)


def _with_side(side: str, draw: Draw) -> Draw:
    """A panel with the side of its camera in the title."""

    def titled(axes: Axes) -> None:
        draw(axes)
        axes.set_title(f"{side}: {axes.get_title(loc='left')}", loc="left")

    return titled


def draw_points_in_space(
    evaluation: StereoEvaluation, rig: StereoRig | None, kind: str = "png", panel: str | None = None
) -> bytes:
    """Draw the errors of triangulated points, or one of `SPACE_PANELS`; see `draw_camera`."""
    found = evaluation.by_view if evaluation.rig is None else evaluation.rig
    unit = plain(evaluation.unit)
    errors = found.errors[np.isfinite(found.errors[:, 0])]
    others = [] if rig is None else [(rig.right.camera, rig.pose)]
    names = () if rig is None else _SIDES
    panels: dict[str, Draw] = {
        "across": lambda axes: _draw_cloud(axes, errors[:, :2], "Y down", unit),
        "depth": lambda axes: _draw_cloud(axes, errors[:, [0, 2]], "Z depth", unit),
        "depths": lambda axes: _draw_depths(axes, found, unit),
        "views": lambda axes: _draw_space_views(axes, evaluation, unit),
        "poses": lambda axes: draw_poses(axes, None if rig is None else rig.left, others, names),
    }
    if panel is not None:
        return _alone(panel, panels[panel], kind)
    rows = [["across", "depth", "poses"], ["depths", "views", "views"]]
    title = (
        f"{found.n_points} triangulated points: rms {found.rmse:.4g} {unit}, NSCE {found.nsce:.3g}, "
        f"epipolar rms {found.epipolar_px:.3g} px"
    )
    return _page(rows, (1, 1), panels, title, (16.0, 9.0), kind)


def _page(
    rows: list[list[str]],
    heights: tuple[float, ...],
    panels: Mapping[str, Draw],
    title: str,
    size: tuple[float, float],
    kind: str,
) -> bytes:
    """Draw rows of panels on one page."""

    def draw(figure: Figure) -> None:
        axes = figure.subplot_mosaic(
            rows,  # type: ignore[arg-type]
            height_ratios=list(heights),
            per_subplot_kw={"poses": {"projection": "3d"}} if any("poses" in row for row in rows) else None,
        )
        for name, place in axes.items():
            panels[name](place)
        figure.suptitle(title)

    return picture(draw, size, _PAD, kind)


def _alone(name: str, draw: Draw, kind: str) -> bytes:
    """Draw a single panel."""
    how = {"projection": "3d"} if name == "poses" else {}
    return picture(lambda figure: draw(figure.add_subplot(**how)), _PANEL, _PAD, kind)


def _draw_cloud(axes: Axes, errors: Array, name: str, unit: str) -> None:
    """Draw the errors in the plane of X and another axis of the left camera's frame, such as "Y down"."""
    axes.plot(*errors.T, ".", color=INK, markersize=3, alpha=0.5, rasterized=len(errors) > 2000)
    axes.plot(0, 0, "+", color=ACCENT, markersize=11)
    style(axes, f"Errors in X and {name[0]}, triangulated minus true")
    axes.set(xlabel=f"X right [{unit}]", ylabel=f"{name} [{unit}]", aspect="equal")
    axes.set_adjustable("datalim")
    if name == "Y down":
        axes.invert_yaxis()


def _draw_depths(axes: Axes, found: SpaceError, unit: str) -> None:
    """Draw the error by depth."""
    for part in found.depths:
        axes.plot([part.nearest, part.farthest], [part.rmse] * 2, color=INK, linewidth=3)
        middle = (part.nearest + part.farthest) / 2
        axes.annotate(
            f"{part.relative:.2%}", (middle, part.rmse), (0, 4), textcoords="offset points", ha="center"
        )
    style(axes, "Error by depth, and its share of the depth")
    axes.set(xlabel=f"depth [{unit}]", ylabel=f"rms [{unit}]")
    axes.set_ylim(0, 1.25 * max((part.rmse for part in found.depths), default=0.8))


def _draw_space_views(axes: Axes, evaluation: StereoEvaluation, unit: str) -> None:
    """Draw the error of each pair of views, with the poses of the view and with one rig."""
    ways = [("poses of each view", evaluation.by_view, "0.6")]
    if evaluation.rig is not None:
        alike = np.isclose(evaluation.rig.rmse, evaluation.by_view.rmse, rtol=1e-4)
        ways = [*([] if alike else ways), ("one rig", evaluation.rig, INK)]
    names = list(ways[0][1].views)
    width = 0.8 / len(ways)
    for k, (label, found, colour) in enumerate(ways):
        errors = [found.views.get(name, (0, np.nan))[1] for name in names]
        axes.bar(np.arange(len(names)) + (k + 0.5) * width - 0.4, errors, width, color=colour, label=label)
    if len(names) <= 40:
        axes.set_xticks(np.arange(len(names)), [plain(name[-20:]) for name in names], rotation=90)
    style(axes, "Error of each pair of views")
    axes.set(ylabel=f"rms [{unit}]")
    axes.legend(loc="upper right", frameon=False)
