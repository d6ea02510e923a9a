"""Pictures of cameras, rigs and triangulated points: a page of panels, or one; and a rig in space as SVG."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.calibration.rig.evaluation import StereoEvaluation
from neurocal_cli.calibration.rig.rig import Rig, StereoRig
from neurocal_cli.calibration.rig.space_error import SpaceError
from neurocal_cli.camera.geometry import Array, euler_to_rotation
from neurocal_cli.commands.show.camera_panels import (
    CELLS,
    SIZE,
    Outline,
    Subject,
    draw_poses,
    frustum,
    panels_of,
    targets_of,
)
from neurocal_cli.commands.show.figure import ACCENT, INK, drawing, entitle, plain, style
from neurocal_cli.errors import plural

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_NUMBERS = 14  # cameras with room for a number in each cell
_LABEL = (190.0, 24.0)  # room of a camera's name in the drawing
# The direction of the view of the drawing: from above, and from the right.
_VIEW = euler_to_rotation(np.radians(22.0), 0.0, 0.0) @ euler_to_rotation(0.0, np.radians(30.0), 0.0)
_PAD = 0.12  # inches
_PAGE = (7.6, 11.6)  # two columns, which are still read where a screen or a page is narrow
_PANEL = (5.0, 4.0)  # text of 9 points is still read where the picture is 400 px wide
_SIDES = ("left", "right")
_ROWS = (("residuals", "uncertainty"), ("coverage", "scatter"), ("poses", "learning"), ("views",) * 2)
Draw = Callable[["Axes"], None]


def edge_coverage(rig: Rig) -> tuple[Array, Array]:
    """What each camera (row) sees in the frames that it has in common with each other (column).

    Returns their number (C, C), on the diagonal that of all views, and the share (C, C) of the image's parts
    that hold points then.
    """
    names = list(rig.cameras)
    frames, covered = np.zeros((len(names),) * 2), np.zeros((len(names),) * 2)
    for a, name in enumerate(names):
        camera = rig.cameras[name]
        if not len(camera.points):
            continue
        size = np.array(camera.image_size or np.ceil(camera.points.pixels.max(axis=0)) + 1)
        cells = np.clip((camera.points.pixels + 0.5) * CELLS / size, 0, CELLS - 1).astype(np.intp)
        cell = CELLS * cells[:, 1] + cells[:, 0]
        for b, other in enumerate(names):
            both = {views[name] for views in rig.frames.values() if {name, other} <= set(views)}
            seen = np.array([view in both or a == b for view in camera.points.view_names])
            frames[a, b] = seen.sum()
            covered[a, b] = len(np.unique(cell[seen[camera.points.view_index]])) / CELLS**2
    return frames, covered


def draw_edges(axes: Axes, rig: Rig) -> None:
    """Draw for each pair of cameras how much of the row's image is covered in their common frames."""
    names = [plain(name[-16:]) for name in rig.cameras]
    frames, covered = edge_coverage(rig)
    shown = np.where(frames > 0, covered, np.nan)
    drawn = axes.imshow(shown, cmap="Blues", vmin=0, vmax=1.2)
    places = range(len(names))
    axes.set_xticks(places, names, rotation=90 if len(names) > 4 else 0)
    axes.set_yticks(places, names)
    if len(names) <= _MOST_NUMBERS:
        for (row, column), count in np.ndenumerate(frames):
            cover = f"{count:.0f}\n{covered[row, column]:.0%}" if count else ""
            axes.text(column, row, cover, ha="center", va="center", fontsize=7)
    style(axes, "Frames in common with the camera of the column,\nand how much of the row's image they cover")
    axes.grid(False)
    axes.figure.colorbar(drawn, ax=axes, label="share of the image", shrink=0.7).ax.set_ylim(0, 1)


def targets_of_rig(rig: Rig) -> list[Outline]:
    """The targets of all frames as one of the cameras saw them, in the first camera's frame."""
    of_frames = {next(iter(views.items())) for views in rig.frames.values()}
    return [
        target
        for name, camera in rig.cameras.items()
        for target in targets_of(camera, rig.poses[name])
        if (name, target[0]) in of_frames
    ]


def rig_in_space(rig: Rig) -> str:
    """Draw the cameras and the targets of all frames as SVG; empty without points."""
    targets = targets_of_rig(rig)
    if not targets:
        return ""
    everything = np.vstack([outline for _, outline, _, _ in targets])
    size = SIZE * float(np.linalg.norm(np.ptp(everything, axis=0)))
    cameras = [
        (name, (frustum(camera.camera, size) - rig.poses[name].t) @ rig.poses[name].R)
        for name, camera in rig.cameras.items()
    ]
    flat = [_seen(outline) for _, outline, _, _ in targets], [_seen(corners) for _, corners in cameras]
    low = np.min([part.min(axis=0) for parts in flat for part in parts], axis=0)
    high = np.max([part.max(axis=0) for parts in flat for part in parts], axis=0)
    width, height = 1000.0 * (high - low) / (high - low).max()

    def placed(points: Array) -> Array:
        return np.asarray(1000.0 * (points - low) / (high - low).max())

    boards = "".join(_path(placed(part), closed=True) for part in flat[0])
    lines, labels, taken = "", "", list[Array]()
    for (name, _), part in zip(cameras, flat[1], strict=True):
        centre, *ends = placed(part)
        lines += _path(np.array(ends), closed=True) + "".join(_path(np.array([centre, end])) for end in ends)
        while any((np.abs(centre - other) < _LABEL).all() for other in taken):
            centre = centre + np.array([0.0, _LABEL[1]])  # below the name of a camera beside it
        taken.append(centre)
        labels += f'<text x="{centre[0]:.1f}" y="{centre[1]:.1f}" font-size="22">{escape(name[-16:])}</text>'
    return (
        f'<svg viewBox="-20 -20 {width + 40:.0f} {height + 40:.0f}" role="img" '
        'aria-label="cameras and boards">'
        f'<path d="{boards}" class="axis" fill="none" stroke-width="1.5"/>'
        f'<path d="{lines}" class="lines" fill="none" stroke-width="2.5"/>{labels}</svg>'
    )


def _seen(points: Array) -> Array:
    """(n, 2) points in space as they are drawn: to the right, and down."""
    return np.asarray((points @ _VIEW.T)[:, :2])


def _path(points: Array, closed: bool = False) -> str:
    steps: Sequence[str] = [f"{x:.1f} {y:.1f}" for x, y in points.tolist()]
    return f"M{'L'.join(steps)}{'z' if closed else ''}"


def draw_camera(subject: Subject, kind: str = "png", panel: str | None = None) -> bytes:
    """Draw all panels of a camera, or one of `CAMERA_PANELS`; the same subject gives the same bytes."""
    evaluation = subject.evaluation
    title = (
        f"{plain(subject.camera.name)}: rms {evaluation.rmse_px:.4g} px, max {evaluation.max_px:.4g} px, "
        f"{evaluation.n_points} points, {plural(len(evaluation.views), 'view')}"
    )
    rows = [list(row) for row in _ROWS]
    return _page(rows, (1, 1, 1, 0.6), panels_of(subject), title, _PAGE, kind, panel)


def draw_stereo(rig: StereoRig, kind: str = "png", panel: str | None = None) -> bytes:
    """Draw both cameras of a rig side by side, or one of `CAMERA_PANELS` for both; see `draw_camera`."""
    sides = {"left": Subject.of(rig.left), "right": Subject.of(rig.right)}
    panels: dict[str, Draw] = {
        f"{side} {name}": _with_side(side, draw)
        for side, subject in sides.items()
        for name, draw in panels_of(subject).items()
    }
    panels["poses"] = lambda axes: draw_poses(axes, rig.left, [(rig.right.camera, rig.pose)], _SIDES)
    rows = [
        [f"{side} {name}" for side in sides] for name in ("residuals", "uncertainty", "coverage", "views")
    ]
    rows.insert(3, ["poses"] * 2)  # not lowest, where labels in space would be cut off
    heights: tuple[float, ...] = (1, 1, 1, 1.3, 0.7)
    size = _PAGE[0], 1.25 * _PAGE[1]
    if panel not in (None, "poses"):
        rows, heights, panel = [[f"{side} {panel}" for side in sides]], (1,), None
        size = 2 * _PANEL[0], _PANEL[1]
    title = (
        f"rms {rig.rmse_px:.4g} px, max {rig.max_px:.4g} px, {len(rig.pairs)} pairs of views, baseline "
        f"{rig.baseline:.6g} {plain(rig.unit)}"
    )
    return _page(rows, heights, panels, title, size, kind, panel)


def draw_rig(rig: Rig, kind: str = "png") -> bytes:
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
        entitle(axes, f"{side}: {' '.join(axes.get_title(loc='left').split())}")

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
    rows = [["across", "depth"], ["depths", "poses"], ["views"] * 2]
    title = (
        f"{found.n_points} triangulated points: rms {found.rmse:.4g} {unit}, NSCE {found.nsce:.3g}, "
        f"epipolar rms {found.epipolar_px:.3g} px"
    )
    return _page(rows, (1, 1, 0.8), panels, title, (_PAGE[0], 0.8 * _PAGE[1]), kind, panel)


def _page(
    rows: list[list[str]],
    heights: tuple[float, ...],
    panels: Mapping[str, Draw],
    title: str,
    size: tuple[float, float],
    kind: str,
    panel: str | None = None,
) -> bytes:
    """Draw rows of panels on one page, or a single panel."""
    if panel is not None:
        rows, heights, title, size = [[panel]], (1,), "", _PANEL
    with drawing(size, _PAD, kind) as (figure, file):
        axes = figure.subplot_mosaic(
            rows,  # type: ignore[arg-type]
            height_ratios=list(heights),
            per_subplot_kw={"poses": {"projection": "3d"}} if any("poses" in row for row in rows) else None,
        )
        for name, place in axes.items():
            panels[name](place)
        figure.suptitle(title)
    return file.getvalue()


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
