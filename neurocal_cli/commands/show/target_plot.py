"""Picture of an estimated target. matplotlib is imported only when a picture is drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.commands.show.figure import picture, style
from neurocal_cli.observations.planes import planes_are_named
from neurocal_cli.observations.target import Target

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LONGEST = 0.12  # of the plane's size, for the longest arrow
_LEVELS = 13
_WIDTH, _HEIGHT = 5.5, 4.5  # inches of a panel


def draw_target(target: Target, unit: str, kind: str = "png") -> bytes:
    """Draw the estimated points of each plane: height as contours, offsets in the plane as arrows."""
    planes = int(target.plane.max()) + 1

    def draw(figure: Figure) -> None:
        rows = figure.subplots(planes, 2, squeeze=False)
        for plane, (height, arrows) in enumerate(rows):
            _draw_plane(target, plane, unit, height, arrows)
        figure.suptitle(f"The target as it was found, std {np.sqrt((target.std**2).mean()):.2g} {unit}")

    return picture(draw, (2 * _WIDTH, planes * _HEIGHT), 0.12, kind)


def _draw_plane(target: Target, plane: int, unit: str, height: Axes, arrows: Axes) -> None:
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
    x, y, _ = axes @ centred.T
    dx, dy, dz = axes @ offsets.T
    most = float(np.abs(dz).max()) or 1.0
    drawn = height.tricontourf(x, y, dz, levels=np.linspace(-most, most, _LEVELS), cmap="RdBu_r")
    height.figure.colorbar(drawn, ax=height, label=f"height [{unit}]")
    height.plot(x, y, ".", color="0.3", markersize=2)
    name = ""
    if target.point is not None and planes_are_named(target.point):
        name = f"{str(target.point[rows][0]).split('/')[0]}, "
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
