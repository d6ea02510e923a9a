"""Advice as text, as JSON, and as pictures of the board as it should be seen."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from neurocal_cli.calibration.advice import Advice, Candidate
from neurocal_cli.calibration.calibration import Calibration, Verdict
from neurocal_cli.calibration.rig.advice import RigAdvice
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.verdict.findings import two_digits
from neurocal_cli.camera.geometry import Array
from neurocal_cli.commands.show.camera_panels import CORNERS, outline_of
from neurocal_cli.commands.show.figure import ACCENT, INK, drawing, panels_in_rows, plain, style
from neurocal_cli.commands.show.text import Report, attributes
from neurocal_cli.errors import one_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ACROSS = ("far left", "left", "middle", "right", "far right")
_DOWN = ("very top", "top", "middle", "bottom", "very bottom")
_SIDES = ("right", "lower right", "lower", "lower left", "left", "upper left", "upper", "upper right")
_MOST_DOTS = 4000
_HALF = {"h": (0.5, 0.0), "v": (0.0, 0.5)}  # from a vertex to the mid-point of an edge [squares]
_PIECES = 12  # of each side of an outline


def advice_report(advice: Advice, verdict: Verdict | None) -> Report:
    """The uncertainty so far, also as in the verdict, and a line for each view with that after it."""
    there = float("nan") if verdict is None else verdict.measures.get("projection_px", float("nan"))
    usual = f"; {two_digits(there)} px at that distance" if math.isfinite(there) else ""
    lines = [
        f"std of predicted pixels {_px(advice.before)} at most, for points at half to ten times the distance "
        f"of the views{usual}",
        *(f"{number}. {text}" for number, text in enumerate(advised_views(advice), start=1)),
    ]
    pairs = zip(advice.views, advice.after, strict=True)
    views = [{**_view_json(view), "worst_px": after} for view, after in pairs]
    return Report({"worst_px": advice.before, "views": views}, below=lines)


def advised_views(advice: Advice) -> list[str]:
    """Each advised view in words, with the uncertainty that is left after it."""
    return [
        f"{_described(view)}: {_px(after)}" for view, after in zip(advice.views, advice.after, strict=True)
    ]


def _described(view: Candidate) -> str:
    """Describe position, width, tilt and roll of a view; there are five positions in each direction."""
    across, down = (min(int(5 * share), 4) for share in view.position)
    if across == down == 2:
        place = "in the middle"
    elif down == 2:
        place = f"at the {_ACROSS[across]}"
    else:
        place = f"at the {_DOWN[down]}" + (f" {_ACROSS[across]}" if across != 2 else "")
    parts = [f"target {place}", f"{100 * view.width:.0f} % of the image wide"]
    if view.tilt:
        side = _SIDES[round(view.way / 45) % 8]
        parts.append(f"tilted by {view.tilt:.0f} degrees with its {side} side nearer")
    else:
        parts.append("not tilted")
    if view.roll:
        parts.append(f"turned by {view.roll:.0f} degrees")
    return ", ".join(parts)


def _px(value: float) -> str:
    return f"{value:.3g} px" if value < float("inf") else "unknown, as the views do not determine the camera"


def rig_advice_report(advice: RigAdvice) -> Report:
    """A line for each view that ties two cameras of a rig."""
    unit = one_line(advice.unit)
    lines = [
        "std of where one camera sees what another one sees, of the weakest pair: "
        f"{100 * advice.share:.2g} % of the distance of the targets"
    ]
    for number, tie in enumerate(advice.views, start=1):
        first, second = map(one_line, tie.cameras)
        lines.append(
            f"{number}. {first} and {second}: in the image of {first} {_described(tie.view)}: "
            f"{tie.before:.3g} -> {tie.after:.3g} {unit}"
        )
    views = [
        {"cameras": tie.cameras, **_view_json(tie.view), **attributes(tie, "std=before std_after=after")}
        for tie in advice.views
    ]
    return Report({**attributes(advice, "weakest_share=share unit"), "views": views}, below=lines)


def _view_json(view: Candidate) -> dict[str, Any]:
    return {
        **attributes(view, "position width tilt_deg=tilt nearer_side_deg=way roll_deg=roll"),
        **attributes(view.pose, "rotation=R translation=t"),
        "outline": view.outline,
    }


def draw_advice(advice: Advice, calibration: Calibration, kind: str = "png") -> bytes:
    """Draw each view that is advised for a camera (png, pdf or svg)."""
    views = [(view, f"then {after:.3g} px") for view, after in zip(advice.views, advice.after, strict=True)]
    title = f"Views to take next; now {advice.before:.3g} px. The thick side is near."
    return draw_views(calibration, views, title, kind)


def draw_rig_advice(advice: RigAdvice, rig: Rig, kind: str = "png") -> bytes:
    """Draw each view of the first advised pair of cameras, in the image of the first of them."""
    cameras = advice.views[0].cameras
    ties = [tie for tie in advice.views if tie.cameras == cameras]
    (first, second), unit = map(plain, cameras), plain(advice.unit)
    views = [(tie.view, f"then {tie.after:.3g} {unit}") for tie in ties]
    title = f"Views for {first} and {second}, in the image of {first}; now {ties[0].before:.3g} {unit}"
    return draw_views(rig.cameras[cameras[0]], views, title, kind)


def draw_views(
    calibration: Calibration, views: Sequence[tuple[Candidate, str]], title: str, kind: str
) -> bytes:
    """Draw views, each with a text, over the points of the views that a camera has taken so far."""
    assert calibration.image_size is not None
    width, height = calibration.image_size
    columns = min(2, len(views))
    rows = -(-len(views) // columns)
    squares, rim = board_of(calibration)
    each = 3.1 if columns > 1 else 5.0
    size = columns * each, rows * (each * height / width + 0.25) + 0.3
    with drawing(size, 0.05, kind) as (figure, file):
        pixels = calibration.points.pixels[:: max(1, len(calibration.points) // _MOST_DOTS)]
        places = panels_in_rows(figure, len(views), columns)
        for number, (axes, (view, text)) in enumerate(zip(places, views, strict=True), start=1):
            axes.plot(*pixels.T, ".", color="0.8", markersize=2)
            _draw_view(axes, view, calibration, squares, rim)
            style(axes, f"{number}: {text}")
            axes.spines[["top", "right"]].set_visible(True)
            axes.set(
                xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xticks=[], yticks=[]
            )
        figure.suptitle(title)
    return file.getvalue()


def board_of(calibration: Calibration) -> tuple[Array, Array]:
    """Corners (n, 4, 3) of a chessboard's dark squares, and its rim (m, 3), closed.

    Only the ids of mid-points tell the squares. Other targets have none, and the rim of their points.
    """
    points = calibration.points
    world, first = np.unique(points.world, axis=0, return_index=True)
    ids: list[str] = [] if points.point is None else np.asarray(points.point)[first].tolist()
    found = [re.fullmatch(r"(h|v):(-?\d+):(-?\d+)", name) for name in ids]
    places = [np.array([int(m[2]), int(m[3])]) + _HALF[m[1]] for m in found if m is not None]
    if not places or len(places) < len(world):
        corners = outline_of(world)
        return np.empty((0, 4, 3)), _closed(corners) if len(corners) < len(world) else np.empty((0, 3))
    grid = np.column_stack([places, np.ones(len(places))])
    to_world = np.linalg.lstsq(grid, world, rcond=None)[0]  # the plane of a board that is bent
    columns, rows = grid[:, :2].max(axis=0).astype(int) + 1
    dark = [(c, r) for c in range(-1, columns) for r in range(-1, rows) if (c + r) % 2 == 0]
    rim = CORNERS * (columns + 1, rows + 1) - 1
    squares = np.array(dark)[:, None] + CORNERS
    return np.insert(squares, 2, 1, axis=2) @ to_world, _closed(np.insert(rim, 2, 1, axis=1) @ to_world)


def _closed(corners: Array) -> Array:
    """The sides of a polygon, each in pieces, so that a lens may bend them."""
    share = np.linspace(0, 1, _PIECES, endpoint=False)[:, None]
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    return np.vstack([*((1 - share) * a + share * b for a, b in sides), corners[:1]])


def _draw_view(axes: Axes, view: Candidate, calibration: Calibration, squares: Array, rim: Array) -> None:
    """Draw the board of a view, with an outline that is the thicker the nearer it is."""
    from matplotlib.collections import LineCollection, PolyCollection

    def seen(world: Array) -> Array:
        return calibration.camera.project(view.pose.to_camera(world))[0]

    if len(squares):
        polygons = seen(squares.reshape(-1, 3)).reshape(squares.shape[0], 4, 2)
        axes.add_collection(PolyCollection(list(polygons), facecolor=INK, alpha=0.75, linewidth=0))
    else:
        axes.plot(*seen(calibration.points.world).T, ".", color=INK, markersize=3)
    if len(rim):
        depth, pixels = view.pose.to_camera(rim)[:, 2], seen(rim)
        near = (depth.max() - depth) / max(float(np.ptp(depth)), 0.05 * float(depth.max()))
        pieces = np.stack([pixels[:-1], pixels[1:]], axis=1)
        axes.add_collection(
            LineCollection(list(pieces), linewidths=1 + 4 * near[1:], colors=ACCENT, capstyle="round")
        )
