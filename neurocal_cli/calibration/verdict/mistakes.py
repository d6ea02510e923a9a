"""Mistakes in the rows of a file, in one view or in all of them: the causes that have no unknowns.

Each changes the points in one way, and with the opposite change they would fit. A view whose points
contradict the camera of the others fits it then. In all views a flat target tells: a homography maps it to
the pixels of each, but for distortion, and far worse with its points in another order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from neurocal_cli.adjustment.adjust import NEARBY, adjust
from neurocal_cli.adjustment.problem import problem_for
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.calibration.fit import fit
from neurocal_cli.calibration.point_errors import rms
from neurocal_cli.calibration.verdict.effects import BENDS
from neurocal_cli.calibration.verdict.findings import (
    EXACT,
    FEWEST,
    LEVEL,
    MISFIT,
    POOR,
    Mistake,
    Said,
    likeliest,
    log_odds,
    pixel_spread,
    said,
)
from neurocal_cli.calibration.verdict.rivals import explained_by_shape
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.geometry import Array, distinct_rows, median
from neurocal_cli.camera.homographies import homographies, homography_at
from neurocal_cli.errors import NeurocalError
from neurocal_cli.network.options import options_for
from neurocal_cli.observations.points import Correspondences

# Of one view. Repeated by test_outlier_rejection.py (slow: 105 sets with one wrong view, all found; 200 clean
# ones, none blamed).
_HOLDS = 2.0  # times the rms error of the other views
_BLURRED = 0.08  # of the pixels' spread: up to this rms error points are badly measured, not mixed up
_ALIKE = 0.01  # largest relative difference between the scale changes along u and v that a zoom makes
_FOCAL, _CENTRE = (0, 2), (3, 4)  # places among A's entries
# Of all views (test_mistakes.py).
ENOUGH_VIEWS = 40
"""Views that tell a mistake in all of them."""

Mended = Callable[[Correspondences], Correspondences | None]
"""The points without the mistake; None if they cannot have it."""


def _scaled(*by: float) -> Mended:
    return lambda points: replace(points, pixels=(points.pixels + 0.5) * by - 0.5)


def _turned(points: Correspondences) -> Correspondences | None:
    if points.image_size is None:
        return None
    return replace(points, pixels=np.array(points.image_size) - 1 - points.pixels)


def _shifted(by: int) -> Mended:
    """Each row has the world point of another one, in the order of the view with the most points."""

    def mended(points: Correspondences) -> Correspondences | None:
        rows = np.flatnonzero(points.view_index == np.bincount(points.view_index).argmax())
        board = points.world[rows]
        _, label = distinct_rows(np.concatenate([board, points.world]))
        place = np.full(label.max() + 1, -1)
        place[label[: len(board)]] = np.arange(len(board))
        at = place[label[len(board) :]]
        return replace(points, world=board[(at - by) % len(board)]) if at.min() >= 0 else None

    return mended


def _sides(points: Correspondences) -> tuple[int, int, Array, Array] | None:
    """The axis along the rows of a grid, that along its columns, and its numbers along both.

    The axis that changes more often from point to point runs along the rows.
    """
    sides = [np.unique(points.world[:, axis]) for axis in range(3)]
    axes = [axis for axis in range(3) if len(sides[axis]) > 1]
    if len(axes) != 2:
        return None
    first = points.world[points.view_index == 0]
    slow, fast = sorted(axes, key=lambda axis: np.count_nonzero(np.diff(first[:, axis])))
    return fast, slow, sides[fast], sides[slow]


def _exchanged(points: Correspondences) -> Correspondences | None:
    """The points of a grid with as many columns as it has rows, in the same order."""
    grid = _sides(points)
    if grid is None or len(grid[2]) == len(grid[3]):
        return None
    fast, slow, along, down = grid
    column, row = (np.searchsorted(side, points.world[:, k]) for k, side in ((fast, along), (slow, down)))
    world, place = points.world.copy(), row * len(along) + column
    world[:, fast] = place % len(down) * np.diff(along).mean()
    world[:, slow] = place // len(down) * np.diff(down).mean()
    return replace(points, world=world)


def _says_exchanged(points: Correspondences) -> Said:
    grid = _sides(points)
    assert grid is not None
    columns, rows = len(grid[2]), len(grid[3])
    return (
        f"points fit a board of {rows} columns and {columns} rows, but are given with {columns} columns and "
        f"{rows} rows: rows and columns are exchanged",
        1.0,
    )


_LOOKS = "with the opposite change the points fit the camera of the other views"
_MAPS = "with the opposite change a homography maps the target to the pixels of each view"
_AS_STORED = "give all images as they were stored"
MISTAKES: tuple[Mistake[Correspondences], ...] = (
    Mistake(
        "u and v exchanged", _LOOKS, "name the columns in their order", said("u and v are exchanged"),
        POOR, lambda points: replace(points, pixels=points.pixels[:, ::-1]),
    ),
    Mistake(
        "an image turned by 180 degrees", _LOOKS, _AS_STORED,
        said("image is turned by 180 degrees against the others"), POOR, _turned,
    ),
    *(
        Mistake(
            f"an image of {name} the size", _LOOKS, _AS_STORED, said(f"image is of {name} the size"),
            POOR, _scaled(scale), scale,
        )
        for scale, name in ((2.0, "half"), (0.5, "twice"))
    ),
    *(
        Mistake(
            "an interlaced image", _LOOKS, _AS_STORED,
            said(f"{name} is of half resolution, as in interlaced images"), POOR,
            _scaled(*by), 2.0**0.5,
        )
        for by, name in (((2.0, 1.0), "u"), ((1.0, 2.0), "v"))
    ),
    *(
        Mistake(
            "rows shifted by one", f"{_LOOKS}, or {_MAPS}", "give each pixel the X,Y,Z of its point",
            said("rows are shifted by one against the pixels"), POOR, _shifted(by),
        )
        for by in (1, -1)
    ),
    Mistake(
        "rows and columns exchanged", _MAPS, "exchange --cols and --rows, or the numbers in the file",
        _says_exchanged, POOR, _exchanged,
    ),
)  # fmt: skip
"""All mistakes; those with the same name are alternatives of one."""


def mistake_in_all_views(points: Correspondences) -> tuple[str, str] | None:
    """The mistake that keeps a homography from mapping the target to each view, and what to do; or None."""
    points = points.of_few_views(ENOUGH_VIEWS)
    axes = np.flatnonzero(np.ptp(points.world, axis=0))
    if len(axes) != 2:
        return None
    members = [points.view_index == view for view in range(points.n_views)]
    members = [rows for rows in members if np.count_nonzero(rows) >= FEWEST]

    def misfit(world: Array) -> float:
        """Median over the views of the rms error of a homography over the spread of the pixels."""
        of_views = [_misfit(world[rows][:, axes], points.pixels[rows]) for rows in members]
        return max(float(median(np.array(of_views))), EXACT)

    given = misfit(points.world) if members else 0.0
    tried = [(one, one.mended(points)) for one in MISTAKES if given > MISFIT]
    errors = [(one, misfit(mended.world)) for one, mended in tried if mended is not None]
    n = 2 * len(points) - 8 * points.n_views
    told = likeliest((log_odds(given**2, error**2, n), one) for one, error in errors if error < MISFIT)
    return next(((f"the {one.say(points)[0]}", one.advice) for one in told), None)


def _misfit(plane: Array, pixels: Array) -> float:
    spread = float(np.sqrt(pixels.var(axis=0).sum()))
    if not (spread > 0 and (plane.std(axis=0) > 0).all()):
        return np.inf
    scaled = (pixels - pixels.mean(axis=0)) / spread
    off = homography_at(homographies(plane[None], scaled[None]), plane[None])[0] - scaled
    rms = float(np.sqrt((off**2).sum(axis=1).mean()))
    return rms if np.isfinite(rms) else np.inf


def why_odd(
    points: Correspondences, camera: Camera, rmse_px: float, otherwise: str, posed: bool = True
) -> str:
    """Explain why one view, of which these are the points, contradicts the others.

    The camera is calibrated from the other views, and `rmse_px` is their rms error [px]. `posed` tells
    whether poses were estimated. A reason is "its u and v are exchanged", for example; it is `otherwise` if
    no hypothesis fits. One has to leave as little error as the other views have, and to beat a bent target by
    the `LEVEL` of all causes: seen from afar, a turned image or one of another size looks nearly like the
    same target in another pose, and a bend of the board takes in the rest.
    """
    if not arrange(points).nearly_flat.all() or len(points) < FEWEST:
        return otherwise
    limit, plain = _HOLDS * rmse_px, located(points, camera)
    mistakes = [
        (f"its {one.say(points)[0]}", error_of_view(mended, camera), one.pixel)
        for one in MISTAKES
        if (mended := one.mended(points)) is not None
    ]
    if plain is None:
        return next((reason for reason, error, _ in mistakes if error < limit), otherwise)
    own = rms(plain)
    if not posed and own < limit:
        return "its given pose is wrong: its points fit another one"

    def odds(error: float, unknowns: int = 0) -> float:
        """Errors below the other views' do not count."""
        before, after = (max(one, rmse_px) ** 2 for one in (own, error))
        return log_odds(before, after, 2 * len(points) - 6, unknowns) if np.isfinite(error) else -np.inf

    # A turned image needs no unknowns, so it is more probable than a crop that looks the same by chance.
    known = [(error, odds(error / scale), reason) for reason, error, scale in mistakes]
    (zoomed, a), (moved, b) = (_with_free(plain, some) for some in (_FOCAL, _CENTRE))
    times = a[[0, 2]] / np.array(camera.entries)[[0, 2]]
    if abs(times[0] / times[1] - 1) < _ALIKE:
        how = f"it fits another zoom or focus: a focal length of {a[0]:.5g} px"
        known.append((zoomed, odds(zoomed, 2), how))
    how = f"it fits another camera or crop: the image centre ({b[3]:.0f}, {b[4]:.0f})"
    known.append((moved, odds(moved, 2), how))
    bent = own * float(np.sqrt(1.0 - explained_by_shape(plain.problem.minimum(plain.adjusted))))
    least = LEVEL + max(odds(bent, len(BENDS)), 0.0)
    likely = [(evidence, reason) for error, evidence, reason in known if error < limit and evidence > least]
    if likely:
        return max(likely)[1]
    free, _ = _with_free(plain, (*_FOCAL, *_CENTRE))
    if free > _BLURRED * pixel_spread(points):
        return otherwise
    if own < _HOLDS * free:
        ratio = f"{own / rmse_px:.2g} times that of the others"
        return f"its rms error is {own:.2g} px, {ratio}: blurred, or bent"
    return "its points do not lie as in the other views: another target, a bent one, or another lens"


def error_of_view(points: Correspondences, camera: Camera) -> float:
    """Rms error [px] of one view's points with their pose fitted; infinite if that fails."""
    posed = located(replace(points, covariance=None, across=None), camera)
    return np.inf if posed is None else rms(posed)


def located(points: Correspondences, camera: Camera) -> Solution | None:
    """The view's pose with the camera; None if it cannot be estimated."""
    return solved(points, 3, intrinsics=camera.intrinsics, distortion=camera.distortion)


def solved(points: Correspondences, type: int, more_starts: bool = True, **given: Any) -> Solution | None:
    """The solution of `problem_for` points that may be wrong; None if there is none."""
    try:
        return fit(problem_for(points, type, **given), options_for("lm"), more_starts=more_starts)
    except NeurocalError:  # a camera that cannot have seen these pixels is no explanation
        return None


def _with_free(plain: Solution, free: tuple[int, ...]) -> tuple[float, Array]:
    """The rms error [px], and the entries (5,) of A [px], with some of them free; infinite if that fails."""
    problem, views = plain.problem, plain.problem.views
    moving = np.isin(np.arange(len(problem.free_camera)), free)
    try:
        adjusted = adjust(views.batches, plain.state, moving, True, NEARBY)
    except (np.linalg.LinAlgError, FloatingPointError):
        return np.inf, np.full(5, np.nan)
    rmse = float(np.sqrt(adjusted.cost.sum() / len(problem.points))) * views.pixel_scale
    entries = views.pixel_scale * adjusted.state.entries[0] + np.array([0, 0, 0, *views.pixel_centre])
    return rmse if np.isfinite(rmse) else np.inf, entries
