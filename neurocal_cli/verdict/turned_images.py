"""Test whether some of the images are turned by 180 degrees against the others.

Programs that turn photographs upright make such images of a camera that was held upside down. In them the
image centre and the distortion are mirrored at the middle of the image. The pose of the board absorbs the
rest, so that the image centre seems to move to and fro between the views. The images are turned if a single
camera fits once they are turned back, nearly as well as one with a centre of its own for each view.

The board is used as it is given, because an estimated one may have adapted to the turned images.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.adjust import Adjusted, adjust
from neurocal_cli.bundle_adjustment.cross_validation import reduced
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.leave_out import Quadratics
from neurocal_cli.verdict.moving_centre import least_with_own_centres
from neurocal_cli.verdict.view_groups import divided

# Repeated by tests/test_turned_images.py. Turned images of photographs explain 0.83 to 0.98 of what centres
# of each view explain, and a centre that moves at random 0.77 in 4 views, 0.65 in more.
_SHARE = 0.8
_GAIN = 20.0  # least gain in log evidence, as of a moving centre
_FEWEST = 3  # fewest views
_STEPS = 30
_ROUNDS = 5
_TURN = np.array([-1.0, -1.0, 1.0])


def can_show(n_views: int, contradiction: float, spare: float) -> bool:
    """Whether so many views, with this rms error over the noise floor, can show that images are turned."""
    return n_views >= _FEWEST and spare * np.log(contradiction) > _GAIN


def turned_images(
    views: Views, state: CameraState, free: NDArray[np.bool_], image_size: tuple[int, int], spare: float
) -> tuple[str, ...]:
    """Names of the images that are turned by 180 degrees; empty if none are.

    If they are half of all, either half may be named. The state is normalised, `free` (5 + K,) are the
    estimated ones of A's entries and the coefficients, and `spare` are the equations beyond the unknowns.
    Raises `numpy.linalg.LinAlgError` if the views do not determine the camera.
    """
    middle = ((np.array(image_size) - 1) / 2 - views.pixel_centre) / views.pixel_scale
    common = adjust(views.batches, state, free, True, _STEPS)
    before = float(common.cost.sum())
    q = reduced(common.normal, free, True)
    centre = np.flatnonzero(np.isin(np.flatnonzero(free), (3, 4)))
    member = divided(Quadratics(q.S[:, centre[:, None], centre], q.g[:, centre], q.cost))
    best, found = common, None
    for _ in range(_ROUNDS):
        if member is None or member.all() or not member.any():
            break
        tried = _with_turned(views, common.state, member, free, middle)
        if not tried.cost.sum() < best.cost.sum():
            break
        best, found = tried, member
        member = member ^ _fits_turned(views, tried, member, middle)
    if found is None:
        return ()
    after, least = float(best.cost.sum()), least_with_own_centres(views, common.state, free, q)
    if before - after < _SHARE * (before - least) or 0.5 * spare * np.log(before / after) < _GAIN:
        return ()
    fewer = found if 2 * np.count_nonzero(found) <= len(found) else ~found
    return tuple(np.array(views.names)[fewer].tolist())


def _with_turned(
    views: Views, state: CameraState, member: NDArray[np.bool_], free: NDArray[np.bool_], middle: Array
) -> Adjusted:
    """The camera, with the pixels of some views (V,) turned."""
    return adjust(_turned(views, member, middle).batches, _posed(state, member), free, True, _STEPS)


def _fits_turned(
    views: Views, adjusted: Adjusted, member: NDArray[np.bool_], middle: Array
) -> NDArray[np.bool_]:
    """(V,) which views fit the camera better the other way round."""
    none = np.zeros(5 + adjusted.state.k.shape[-1], dtype=bool)
    other = np.ones(len(member), dtype=bool)
    again = adjust(_turned(views, ~member, middle).batches, _posed(adjusted.state, other), none, True, _STEPS)
    return np.asarray(again.cost < adjusted.cost)


def _turned(views: Views, member: NDArray[np.bool_], middle: Array) -> Views:
    pixels = np.where(member[views.index][:, None], 2 * middle - views.pixels, views.pixels)
    return replace(views, pixels=pixels)


def _posed(state: CameraState, member: NDArray[np.bool_]) -> CameraState:
    """The camera's poses with some views turned round its axis."""
    turn = np.where(member[:, None], _TURN, 1.0)
    return replace(state, R=turn[:, :, None] * state.R, t=turn * state.t)
