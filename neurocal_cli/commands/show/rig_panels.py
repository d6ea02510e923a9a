"""What pairs of cameras of a rig see together, and the rig in space, as a drawing of a page."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, euler_to_rotation
from neurocal_cli.commands.show.camera_panels import Outline, frustum, targets_of
from neurocal_cli.commands.show.figure import plain, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CELLS = 6  # across and down, as in the verdict
_MOST_NUMBERS = 14  # cameras with room for a number in each cell
_SIZE = 0.12  # of a drawn camera, relative to the scene
_LABEL = (190.0, 24.0)  # room of a camera's name in the drawing
# The direction of the view of the drawing: from above, and from the right.
_VIEW = euler_to_rotation(np.radians(22.0), 0.0, 0.0) @ euler_to_rotation(0.0, np.radians(30.0), 0.0)


@frozen_dataclass(eq=False)
class EdgeCoverage:
    """Of each camera (row): what it sees in the frames that it has in common with each other (column)."""

    frames: Array  # (C, C) number of common frames; on the diagonal, of all views
    covered: Array  # (C, C) share of the image's parts that hold points then


def edge_coverage(rig: Rig) -> EdgeCoverage:
    """What pairs of cameras see together."""
    names = list(rig.cameras)
    frames, covered = np.zeros((len(names),) * 2), np.zeros((len(names),) * 2)
    for a, name in enumerate(names):
        camera = rig.cameras[name]
        if not len(camera.points):
            continue
        size = np.array(camera.image_size or np.ceil(camera.points.pixels.max(axis=0)) + 1)
        cells = np.clip((camera.points.pixels + 0.5) * _CELLS / size, 0, _CELLS - 1).astype(np.intp)
        cell = _CELLS * cells[:, 1] + cells[:, 0]
        for b, other in enumerate(names):
            both = {views[name] for views in rig.frames.values() if {name, other} <= set(views)}
            seen = np.array([view in both or a == b for view in camera.points.view_names])
            frames[a, b] = seen.sum()
            covered[a, b] = len(np.unique(cell[seen[camera.points.view_index]])) / _CELLS**2
    return EdgeCoverage(frames, covered)


def draw_edges(axes: Axes, rig: Rig) -> None:
    """Draw for each pair of cameras how much of the row's image is covered in their common frames."""
    found, names = edge_coverage(rig), [plain(name[-16:]) for name in rig.cameras]
    shown = np.where(found.frames > 0, found.covered, np.nan)
    drawn = axes.imshow(shown, cmap="Blues", vmin=0, vmax=1.2)
    places = range(len(names))
    axes.set_xticks(places, names, rotation=90 if len(names) > 4 else 0)
    axes.set_yticks(places, names)
    if len(names) <= _MOST_NUMBERS:
        for (row, column), count in np.ndenumerate(found.frames):
            cover = f"{count:.0f}\n{found.covered[row, column]:.0%}" if count else ""
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
    size = _SIZE * float(np.linalg.norm(np.ptp(everything, axis=0)))
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
