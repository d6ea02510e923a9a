"""The panel of poses: cameras and targets in space, in the frame of the (left) camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from neurocal_cli.calibration import Calibration
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.geometry import Array
from neurocal_cli.plots.figure import ACCENT, INK, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FLAT = 0.02  # greatest thickness over size of a target that is drawn as an outline; admits bent boards
_MOST_NAMES = 8
_SIZE = 0.12  # of a drawn camera, relative to the scene
_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])


def draw_poses(
    axes: Axes, calibration: Calibration | None, others: Sequence[tuple[Camera, Pose]] = ()
) -> None:
    """Draw the targets relative to the camera, coloured by their errors, on axes with ``projection="3d"``.

    `others` are other cameras on the rig, with their poses from the frame of the first camera to theirs.
    """
    space: Any = axes
    style(axes, "Poses")
    if calibration is None or not calibration.views or not len(calibration.points):
        space.text2D(0.5, 0.5, "known only of a calibration", ha="center", transform=space.transAxes)
        space.set_axis_off()
        return
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    points = calibration.points
    errors = np.array([calibration.views[name].rmse_px for name in points.view_names])
    known = errors[np.isfinite(errors)]
    colour = ScalarMappable(Normalize(0, float(known.max()) if known.size else 1.0), colormaps["viridis"])
    extent = [np.zeros((1, 3))]
    for k, name in enumerate(points.view_names):
        world = points.world[points.view_index == k]
        outline = calibration.views[name].pose.to_camera(_outline(world))
        extent.append(outline)
        shade = colour.to_rgba(errors[k])
        flat = len(outline) < len(world)
        closed = np.vstack([outline, outline[:1]]) if flat else outline
        space.plot(*_turned(closed).T, "-" if flat else ".", color=shade, linewidth=1.3, markersize=2)
        if len(points.view_names) <= _MOST_NAMES:
            space.text(*_turned(outline[:1])[0], name[-12:].replace("$", r"\$"), fontsize=7, color="0.3")
    size = _SIZE * max(float(np.linalg.norm(np.ptp(np.vstack(extent), axis=0))), 1e-300)
    for number, (camera, pose) in enumerate([(calibration.camera, _HERE), *others]):
        corners = (_frustum(camera, size) - pose.t) @ pose.R
        extent.append(corners)
        _draw_camera(space, corners, (INK, ACCENT)[number % 2])
    everything = _turned(np.vstack(extent))
    low, high = everything.min(axis=0), everything.max(axis=0)
    space.set_box_aspect(np.maximum(high - low, 0.05 * (high - low).max()), zoom=1.1)
    unit = calibration.unit.replace("$", r"\$")
    space.set(xlabel=f"X right [{unit}]", ylabel=f"Z forward [{unit}]", zlabel=f"Y down [{unit}]")
    space.locator_params(nbins=5)
    space.invert_zaxis()
    space.view_init(elev=22, azim=-60)
    axes.figure.colorbar(colour, ax=axes, label="rms [px]", shrink=0.6, pad=0.16)


_HERE = Pose(np.eye(3), np.zeros(3))


def _turned(points: Array) -> Array:
    """Reorder coordinates to X, Z, Y, because the third axis of the plot is the height."""
    return points[:, [0, 2, 1]]


def _outline(world: Array) -> Array:
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


def _frustum(camera: Camera, size: float) -> Array:
    """Centre and corners of a camera's frustum in its own frame."""
    width, height = camera.image_size or (2 * camera.intrinsics.u0, 2 * camera.intrinsics.v0)
    pixels = np.column_stack([_CORNERS * (width, height), np.ones(4)])
    rays = pixels @ np.linalg.inv(camera.intrinsics.A).T
    return np.vstack([np.zeros(3), size * rays])


def _draw_camera(space: Any, corners: Array, colour: str) -> None:
    centre, *ends = _turned(corners)
    for end, after in zip(ends, [*ends[1:], ends[0]], strict=True):
        space.plot(*np.array([centre, end, after]).T, color=colour, linewidth=1.2)
