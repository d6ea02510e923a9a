"""Panels of a camera, from residuals to the learning curve, and the picture of an estimated target.

matplotlib is imported only when a picture is drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import takewhile
from typing import TYPE_CHECKING, Any

import numpy as np

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.evaluation import CameraEvaluation, evaluate_camera
from neurocal_cli.calibration.verdict.evidence import evidence_of
from neurocal_cli.camera.camera import Camera, camera_of
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.commands.show.figure import ACCENT, INK, colour_bar, drawing, plain, say, style
from neurocal_cli.commands.show.text import round_down
from neurocal_cli.observations.board import planes_are_named
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_ARROWS = 500  # more arrows cannot be distinguished
_MANY_DOTS = 2000  # more dots overlap, and make a large .svg file
_MOST_BARS = 40  # greatest number of views with room for their names
_ACROSS = 24  # letters of names that have room beside each other
_LONGEST_ARROW = 0.04  # greatest length of an rms arrow, as a share of the image width
_ZERO = 1e-16  # px; shown instead of 0 on a logarithmic axis
CELLS = 6
"""Parts of an image across and down, as in the verdict."""
_MOST_DOTS = 5000
_LEVELS = 12  # of uncertainty
_FLAT = 0.02  # greatest thickness over size of a target that is drawn as an outline; admits bent boards
_MOST_NAMES = 24  # of views in space
SIZE = 0.12
"""Of a drawn camera, relative to the scene."""
_LINES = 4  # of names below each other
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""Of a square."""
_HERE = Pose(np.eye(3), np.zeros(3))
_LONGEST = 0.12  # of a target's plane, for the longest arrow
_HEIGHT_LEVELS = 13
_WIDTH, _HEIGHT = 5.0, 3.6  # inches of a target's panel


@frozen_dataclass
class Subject:
    """A camera, points, the camera's errors on them, and its calibration if known."""

    camera: Camera
    points: Correspondences
    evaluation: CameraEvaluation
    calibration: Calibration | None

    @classmethod
    def of(
        cls,
        camera: Calibration | Camera,
        points: Correspondences | None = None,
        evaluation: CameraEvaluation | None = None,
    ) -> Subject:
        """Evaluate a camera on points; by default on a calibration's own points."""
        calibration = camera if isinstance(camera, Calibration) else None
        if points is None:
            points = Correspondences.none() if calibration is None else calibration.points
        return cls(camera_of(camera), points, evaluation or evaluate_camera(camera, points), calibration)

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(width, height) [px], if known."""
        return self.points.image_size or self.camera.image_size


def set_image(axes: Axes, subject: Subject) -> Array:
    """Set the axes to the image, or to the points if its size is unknown; returns the four limits."""
    left, right, top, bottom = frame = _frame(subject)
    axes.set(xlim=(left, right), ylim=(bottom, top), xlabel="u [px]", ylabel="v [px]")
    axes.set_aspect("equal", anchor="W")  # its title begins at its left, and needs the room beside it
    axes.spines[["top", "right"]].set_visible(True)
    return frame


def _frame(subject: Subject) -> Array:
    """Left, right, top and bottom of the image or, if its size is unknown, of the points and a margin."""
    if subject.image_size is not None:
        width, height = subject.image_size
        return np.array([-0.5, width - 0.5, -0.5, height - 0.5])
    low, high = subject.points.pixels.min(axis=0), subject.points.pixels.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 1.0)
    return np.array([low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin])


def draw_residuals(axes: Axes, subject: Subject) -> None:
    """Draw the residuals of all views at their points in the image, enlarged."""
    evaluation = subject.evaluation
    left, right, _, _ = _frame(subject)
    seen = np.flatnonzero(np.isfinite(evaluation.residuals[:, 0]))
    # The choice is random, because every n-th point of a grid with n columns would be one column.
    shown = np.random.default_rng(0).permutation(seen)[:_MOST_ARROWS]
    pixels, residuals = subject.points.pixels[shown], evaluation.residuals[shown]
    spacing = np.sqrt(np.prod(np.ptp(pixels, axis=0)) / len(pixels)) if len(pixels) else 0.0
    length = min(_LONGEST_ARROW * (right - left), max(1.5 * spacing, 0.015 * (right - left)))
    scale = round_down(length / max(evaluation.rmse_px, 1e-300))
    axes.quiver(
        *pixels.T, *residuals.T, color=INK, angles="xy", scale_units="xy", scale=1 / scale, width=0.0025
    )
    axes.plot(subject.camera.intrinsics.u0, subject.camera.intrinsics.v0, "+", color=ACCENT, markersize=11)
    some = "" if len(shown) == len(seen) else f", {len(shown)} of {len(seen)} points"
    style(axes, f"Residuals, {scale:,.10g} times enlarged{some}")
    set_image(axes, subject)
    axes.set_xlabel("u [px]; arrows from observed\nto predicted, + centre")


def draw_scatter(axes: Axes, subject: Subject) -> None:
    """Draw the scatter of the residuals, with a circle of their rms."""
    evaluation = subject.evaluation
    seen = evaluation.residuals[np.isfinite(evaluation.residuals[:, 0])]
    many = len(seen) > _MANY_DOTS
    axes.scatter(
        seen[:, 0], seen[:, 1], s=9, color=INK, alpha=0.15 if many else 0.5, linewidths=0, rasterized=many
    )
    angle = np.linspace(0, 2 * np.pi, 181)
    circle = evaluation.rmse_px * np.array([np.cos(angle), np.sin(angle)])
    axes.plot(*circle, color=ACCENT, linewidth=1.5)
    axes.plot(evaluation.bias_u, evaluation.bias_v, "+", color=ACCENT, markersize=9)
    limit = 1.1 * max(evaluation.max_px, 1e-12) if np.isfinite(evaluation.max_px) else 1.0
    style(axes, f"All residuals, rms {evaluation.rmse_px:.3g} px")
    axes.set(xlim=(-limit, limit), ylim=(limit, -limit), ylabel="dv [px]")
    axes.set_aspect("equal", anchor="W")
    axes.set_xlabel("du [px]; the circle is the rms, + the mean")


def draw_views(axes: Axes, subject: Subject) -> None:
    """Draw the error of each view, in the order of the data."""
    evaluation = subject.evaluation
    errors = np.array([view.rmse_px for view in evaluation.views.values()])
    if len(errors) <= _MOST_BARS:
        axes.bar(np.arange(len(errors)), errors, color=INK, width=0.8 if len(errors) > 3 else 0.3)
    else:
        edges = np.arange(len(errors) + 1) - 0.5
        axes.stairs(np.nan_to_num(errors), edges, fill=True, color=INK)
    axes.axhline(evaluation.rmse_px, color=ACCENT, linewidth=1.2)
    style(axes, f"Error of each view; line: all points, {evaluation.rmse_px:.3g} px")
    axes.set(ylabel="rms [px]", xlim=(-0.6, len(errors) - 0.4))
    if len(errors) <= _MOST_BARS:
        names = [plain(name[-20:]) for name in evaluation.views]
        axes.set_xticks(np.arange(len(errors)), names, rotation=90 if sum(map(len, names)) > _ACROSS else 0)
    else:
        axes.set_xlabel("view, in the order of the data")
    highest = np.nanmax(errors, initial=0.0)
    axes.set_ylim(0, 1.1 * highest if highest > 0 else 1.0)


def draw_learning(axes: Axes, subject: Subject) -> None:
    """Draw the error of the network during training, and the error after bundle adjustment."""
    style(axes, "Learning curve of the best start")
    calibration = subject.calibration
    network = None if calibration is None else calibration.network
    if calibration is None or network is None or not network.curve:
        say(axes, "no training was recorded")
        return
    curve = np.maximum(np.array(network.curve), _ZERO)
    marker = "o" if len(curve) <= 60 else ""
    axes.semilogy(np.arange(len(curve)), curve, marker=marker, markersize=3.5, color=INK)
    axes.axhline(max(network.rmse_after, _ZERO), color=ACCENT, linewidth=1.2)
    what = "iteration" if calibration.trainer == "lm" else "checkpoint"
    axes.set(xlabel=f"{what}; the line is {network.rmse_after:.3g} px,\nafter bundle adjustment")
    axes.set_ylabel("rms of the network [px]")


def draw_coverage(axes: Axes, subject: Subject) -> None:
    """Draw the number of points in each part of the image; parts without points are marked."""
    left, right, top, bottom = set_image(axes, subject)
    u, v = subject.points.pixels.T
    across, down = np.linspace(left, right, CELLS + 1), np.linspace(top, bottom, CELLS + 1)
    counts = np.histogram2d(v, u, (down, across))[0]
    drawn = axes.pcolormesh(across, down, counts, cmap="Blues", vmin=0, vmax=max(1.0, 1.3 * counts.max()))
    colour_bar(axes, drawn, "points")
    for row, column in np.argwhere(counts == 0).tolist():
        middle = across[column : column + 2].mean(), down[row : row + 2].mean()
        axes.plot(*middle, "x", color=ACCENT, markersize=8)
    some = np.random.default_rng(0).permutation(len(u))[:_MOST_DOTS]
    axes.plot(u[some], v[some], ".", color=INK, markersize=1.5, rasterized=len(u) > _MANY_DOTS)
    style(axes, f"Coverage: {100 * np.mean(counts > 0):.0f} % of the image; crosses have no points")
    axes.grid(False)


def draw_uncertainty(axes: Axes, subject: Subject) -> None:
    """Draw the standard deviation of projected pixels over the image, at the points' median distance."""
    evidence = None if subject.calibration is None else evidence_of(subject.calibration)
    projection = None if evidence is None else evidence.projection
    if projection is None or not np.isfinite(projection.std[1]).any():
        style(axes, "Uncertainty")
        say(axes, "known only of a calibration whose image size is known")
        return
    from matplotlib.colors import BoundaryNorm

    set_image(axes, subject)
    u, v = (np.unique(axis) for axis in projection.pixels.T)
    std = np.ma.masked_invalid(projection.std[1].reshape(len(v), len(u)))
    # Levels differ by equal factors, because corners can be 100 times as uncertain as the middle.
    least = max(float(std.min()), 1e-12)
    levels = np.geomspace(least, max(float(std.max()), 1.01 * least), _LEVELS)
    drawn = axes.contourf(u, v, std, levels=levels, cmap="viridis_r", norm=BoundaryNorm(levels, 256))
    colour_bar(axes, drawn, "std [px]", format="%.2g", ticks=levels[::2])
    pixels = subject.points.pixels
    axes.plot(*pixels[:: max(1, len(pixels) // 1000)].T, ".", color="white", markersize=1, alpha=0.7)
    unit = "" if subject.calibration is None else plain(subject.calibration.unit)
    style(axes, f"Uncertainty at {projection.depths[1]:.3g} {unit}: up to {projection.worst:.3g} px")
    axes.grid(False)


Outline = tuple[str, Array, float, bool]
"""Name of a view, outline of its target in the first camera's frame, rms error [px], whether it is flat."""


def targets_of(calibration: Calibration, mounted: Pose | None = None) -> list[Outline]:
    """The targets of a camera's views, in its frame or in that of the first camera, X = R X_first + t."""
    points, found = calibration.points, []
    for k, name in enumerate(points.view_names):
        world = points.world[points.view_index == k]
        outline = calibration.views[name].pose.to_camera(flat := outline_of(world))
        if mounted is not None:
            outline = (outline - mounted.t) @ mounted.R
        found.append((name, outline, calibration.views[name].rmse_px, len(flat) < len(world)))
    return found


def draw_poses(
    axes: Axes,
    calibration: Calibration | None,
    others: Sequence[tuple[Camera, Pose]] = (),
    names: Sequence[str] = (),
    targets: Sequence[Outline] | None = None,
) -> None:
    """Draw targets and cameras in the first one's frame, in 3-D; `others` have poses from it to theirs.

    `names` are those of all cameras, if they are to be shown, and `targets` by default those of the first
    one.
    """
    space: Any = axes
    style(axes, "Poses of the views")
    if calibration is None or not calibration.views or not len(calibration.points):
        space.text2D(0.5, 0.5, "known only of a calibration", ha="center", transform=space.transAxes)
        space.set_axis_off()
        return
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    shown = targets_of(calibration) if targets is None else targets
    errors = np.array([error for _, _, error, _ in shown])
    known = errors[np.isfinite(errors)]
    colour = ScalarMappable(Normalize(0, float(known.max()) if known.size else 1.0), colormaps["viridis"])
    extent = [np.zeros((1, 3))]
    names_of_views = _short([name for name, *_ in shown])
    middle = np.mean([outline.mean(axis=0) for _, outline, *_ in shown], axis=0)
    for name, outline, error, flat in shown:
        extent.append(outline)
        shade = colour.to_rgba(np.asarray(error))
        closed = np.vstack([outline, outline[:1]]) if flat else outline
        space.plot(*_turned(closed).T, "-" if flat else ".", color=shade, linewidth=1.3, markersize=2)
        if label := names_of_views.get(name):
            outermost = outline[np.linalg.norm((outline - middle)[:, :2], axis=1).argmax()]
            space.text(*_turned(outermost[None])[0], label, fontsize=8, color=INK, fontweight="bold")
    size = SIZE * max(float(np.linalg.norm(np.ptp(np.vstack(extent), axis=0))), 1e-300)
    for number, (camera, pose) in enumerate([(calibration.camera, _HERE), *others]):
        corners = (frustum(camera, size) - pose.t) @ pose.R
        extent.append(corners)
        centre, *ends = _turned(corners)
        label = names[number] if names else "camera" if not others else ""
        below = "\n" * (number % _LINES) if len(others) > 1 else ""  # names of cameras that stand close
        space.text(*centre, f"{below}{plain(label)}", fontsize=9, color=INK, ha="right", va="top")
        for end, after in zip(ends, [*ends[1:], ends[0]], strict=True):
            space.plot(*np.array([centre, end, after]).T, color=(INK, ACCENT)[number % 2], linewidth=1.2)
    everything = _turned(np.vstack(extent))
    low, high = everything.min(axis=0), everything.max(axis=0)
    space.set_box_aspect(np.maximum(high - low, 0.05 * (high - low).max()), zoom=1.1)
    unit = calibration.unit.replace("$", r"\$")
    space.set(xlabel=f"X right [{unit}]", ylabel=f"Z forward [{unit}]", zlabel=f"Y down [{unit}]")
    space.locator_params(nbins=4)
    space.tick_params(pad=0, labelsize=8)
    space.yaxis.labelpad = 6
    space.invert_zaxis()
    space.view_init(elev=22, azim=-60)
    scale = axes.inset_axes((1.38, 0.15, 0.04, 0.7))
    axes.figure.colorbar(colour, cax=scale, label="rms [px]")


def _short(names: Sequence[str]) -> dict[str, str]:
    """What distinguishes the names of views: they without what all begin with; none if there are many."""
    if len(names) > _MOST_NAMES:
        return {}
    letters = zip(*names, strict=False) if len(names) > 1 else ()
    common = sum(1 for _ in takewhile(lambda alike: len(set(alike)) == 1, letters))
    return {name: plain((name[common:] or name)[-12:]) for name in names}


def _turned(points: Array) -> Array:
    """Reorder coordinates to X, Z, Y, because the third axis of the plot is the height."""
    return points[:, [0, 2, 1]]


def outline_of(world: Array) -> Array:
    """Corners of a flat target's convex hull, in order; all points of other targets."""
    from scipy.spatial import ConvexHull, QhullError

    centred = world - world.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    if len(world) < 4 or sizes[-1] > _FLAT * sizes[0]:
        return world
    try:
        return np.asarray(world[ConvexHull(centred @ axes[:2].T).vertices])
    except QhullError:  # points on a line
        return world


def frustum(camera: Camera, size: float) -> Array:
    """Centre and corners of a camera's frustum in its own frame."""
    width, height = camera.image_size or (2 * camera.intrinsics.u0, 2 * camera.intrinsics.v0)
    pixels = np.column_stack([CORNERS * (width, height), np.ones(4)])
    rays = pixels @ np.linalg.inv(camera.intrinsics.A).T
    return np.vstack([np.zeros(3), size * rays])


def panels_of(subject: Subject) -> dict[str, Callable[[Axes], None]]:
    """Functions that draw the panels of a camera, by their names in `CAMERA_PANELS`."""
    panels = {
        "residuals": draw_residuals,
        "coverage": draw_coverage,
        "uncertainty": draw_uncertainty,
        "scatter": draw_scatter,
        "poses": lambda axes, subject: draw_poses(axes, subject.calibration),
        "learning": draw_learning,
        "views": draw_views,
    }
    return {name: partial(draw, subject=subject) for name, draw in panels.items()}


def draw_target(target: Target, unit: str, kind: str = "png") -> bytes:
    """Draw the estimated points of each plane: height as contours, offsets in the plane as arrows."""
    planes = int(target.plane.max()) + 1
    with drawing((_WIDTH, 2 * planes * _HEIGHT), 0.12, kind) as (figure, file):
        panels = figure.subplots(2 * planes, 1)
        for plane in range(planes):
            _draw_plane(target, plane, unit, *panels[2 * plane : 2 * plane + 2])
        figure.suptitle(f"The target as it was found, std {np.sqrt((target.std**2).mean()):.2g} {unit}")
    return file.getvalue()


def in_plane(target: Target, plane: int) -> tuple[Array, Array]:
    """Points (n, 2) of a plane of a target from their middle, and offsets (n, 3): across, down, out of it."""
    rows = target.plane == plane
    given, offsets = target.given[rows], target.offsets[rows]
    centred = given - given.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][2]
    # The world's axis along which the plane is longest is drawn across.
    across = np.eye(3)[np.ptp(given, axis=0).argmax()]
    across -= (across @ normal) * normal
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(normal, across), normal])
    axes *= np.where(axes[np.arange(3), np.abs(axes).argmax(axis=1)] < 0, -1.0, 1.0)[:, None]
    return (centred @ axes.T)[:, :2], offsets @ axes.T


def _draw_plane(target: Target, plane: int, unit: str, height: Axes, arrows: Axes) -> None:
    """Draw one plane of a target: the offsets out of it in one panel, those in it in the other."""
    places, offsets = in_plane(target, plane)
    (x, y), (dx, dy, dz) = places.T, offsets.T
    most = float(np.abs(dz).max()) or 1.0
    drawn = height.tricontourf(x, y, dz, levels=np.linspace(-most, most, _HEIGHT_LEVELS), cmap="RdBu_r")
    colour_bar(height, drawn, f"height [{unit}]", format="%.2g")
    height.plot(x, y, ".", color="0.3", markersize=2)
    name = ""
    if target.point is not None and planes_are_named(target.point):
        name = f"{str(target.point[target.plane == plane][0]).split('/')[0]}, "
    style(height, f"{name}out of the plane: {np.ptp(dz):.2g} {unit} from end to end")
    longest = float(np.hypot(dx, dy).max()) or 1.0
    length = _LONGEST * float(np.ptp(x))
    arrows.quiver(
        x, y, dx, dy, color="#1f4e79", angles="xy", scale_units="xy", scale=longest / length, width=3e-3
    )
    arrows.update_datalim(np.column_stack([x, y]) + np.column_stack([dx, dy]) * length / longest)
    style(arrows, f"{name}in the plane: the longest arrow is {longest:.2g} {unit}")
    for panel in (height, arrows):
        panel.set_aspect("equal")
        panel.margins(_LONGEST)
        panel.invert_yaxis()
        panel.set_xlabel(f"[{unit}]")
