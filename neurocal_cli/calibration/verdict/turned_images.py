"""Test whether some of the images are turned by 180 degrees against the others.

Programs that turn photographs upright make such images of a camera that was held upside down. In them the
image centre and the distortion are mirrored at the middle of the image. The pose of the board absorbs the
rest, so that the image centre seems to move to and fro between the views. The images are turned if a single
camera fits once they are turned back, nearly as well as one with a centre of its own for each view.

An estimated board may have adapted to the turned images, and a given one that is bent hides them. So they
are looked for with both. If that is not clear with the given board, it is estimated with the images turned
back, and hardly more than noise must be left.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import Adjusted, adjust
from neurocal_cli.adjustment.cross_validation import reduced
from neurocal_cli.adjustment.leave_out import Quadratics
from neurocal_cli.adjustment.problem import problem_for
from neurocal_cli.adjustment.views import Views
from neurocal_cli.calibration.verdict.moving_centre import least_with_own_centres
from neurocal_cli.calibration.verdict.view_groups import divided
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences

# Repeated by test_turned_images.py. Turned images of photographs explain 0.83 to 0.98 of what centres
# of each view explain, and a centre that moves at random at most 0.7.
_SHARE = 0.8
_EXCESS = 0.85  # with an estimated board: least share of the error above the noise floor
_GAIN = 20.0  # least gain in log evidence, as of a moving centre
_BY_NOISE = 3.0  # standard deviations
# Fewest views, and fewest with which the board is estimated: in fewer, a centre that moves often looks
# like turned images.
_FEWEST, _FEWEST_WITH_BOARD = 5, 8
_STARTS, _STEPS = 5, 30
_ROUNDS = 5
_TURN = np.array([-1.0, -1.0, 1.0])


def can_show(n_views: int, contradiction: float, spare: float) -> bool:
    """Whether so many views, with this rms error over the noise floor, can show that images are turned.

    Without a contradiction, noise changes the logarithm of the likelihood by about the square root of the
    number of views, because a flat target has two conditions in each view.
    """
    return n_views >= _FEWEST and spare * np.log(contradiction) > _GAIN + _BY_NOISE * np.sqrt(n_views)


@frozen_dataclass(eq=False)
class WithBoard:
    """The camera at its minimum for an estimated board."""

    views: Views
    state: CameraState  # normalised
    q: Quadratics  # of the V views in the free parameters, with the board marginalised


def turned_images(
    points: Correspondences,
    views: Views,
    state: CameraState,
    free: NDArray[np.bool_],
    spare: float,
    floor: float,
    estimated: WithBoard | None,
) -> tuple[str, ...]:
    """Names of the images that are turned by 180 degrees; empty if none are.

    If they are half of all, either half may be named. The points have the board as it is given, `views` are
    the same, arranged, and the state is normalised. `free` (5 + K,) are the estimated ones of A's entries and
    the coefficients, `spare` are the equations beyond the unknowns, and `floor` is the squared error [px^2]
    at the noise floor. Raises `numpy.linalg.LinAlgError` if the views do not determine the camera.
    """
    common = adjust(views.batches, state, free, True, _STEPS)
    q = reduced(common.normal, free, True)
    assert points.image_size is not None
    middle = middle_of(points.image_size, views)
    own, given = least_with_own_centres(views, common.state, free, q), float(common.cost.sum())
    if not 0.5 * spare * np.log(given / own) > _GAIN + views.n_views:  # of noise, half of 2 V unknowns
        return ()
    best, member = best_turned(views, common, q, free, middle)
    members = [member] if _is_gain(common, best, spare) else []

    def with_board(some: NDArray[np.bool_]) -> float:
        """Squared error [px^2] with some views turned back, and the board estimated."""
        tried = _with_turned(views, common.state, some, free, middle)
        return _least_with_board(points, _turned(views, some, middle), some, tried, bool(free[1]))

    clear = bool(members) and given - float(best.cost.sum()) > _SHARE * (given - own)
    if estimated is None and clear:
        return _names(views, member)
    if views.n_views < _FEWEST_WITH_BOARD:
        return ()
    if estimated is not None:
        before = float(estimated.q.cost.sum()) * views.pixel_scale**2
        at = replace(common, state=estimated.state, cost=estimated.q.cost)
        best, member = best_turned(estimated.views, at, estimated.q, free, middle)
        members += [member] if _is_gain(at, best, spare) else []
    elif members:
        before = with_board(np.zeros_like(member))
    for some in members:
        after = with_board(some)
        if before - after > _EXCESS * (before - floor) and 0.5 * spare * np.log(before / after) > _GAIN:
            return _names(views, some)
    return ()


def _is_gain(before: Adjusted, after: Adjusted, spare: float) -> bool:
    return bool(0.5 * spare * np.log(before.cost.sum() / after.cost.sum()) > _GAIN)


def _names(views: Views, member: NDArray[np.bool_]) -> tuple[str, ...]:
    """The names of these views, or of all others if those are fewer."""
    fewer = member if 2 * np.count_nonzero(member) <= len(member) else ~member
    return tuple(np.array(views.names)[fewer].tolist())


def middle_of(image_size: tuple[int, int], views: Views) -> Array:
    """(2,) the middle of the image, normalised."""
    return np.asarray(((np.array(image_size) - 1) / 2 - views.pixel_centre) / views.pixel_scale)


def best_turned(
    views: Views, common: Adjusted, q: Quadratics, free: NDArray[np.bool_], middle: Array
) -> tuple[Adjusted, NDArray[np.bool_]]:
    """The camera with the views (V,) turned with which it fits best, and which these are.

    `common` is the camera for all views as they are, with their quadratics q in the free parameters.
    """
    best, member = common, np.zeros(views.n_views, dtype=bool)
    centre = np.flatnonzero(np.isin(np.flatnonzero(free), (3, 4)))
    tried = divided(Quadratics(q.S[:, centre[:, None], centre], q.g[:, centre], q.cost), _STARTS)
    for _ in range(_ROUNDS):
        if tried is None or tried.all() or not tried.any():
            break
        adjusted = _with_turned(views, common.state, tried, free, middle)
        if not adjusted.cost.sum() < best.cost.sum():
            break
        best, member = adjusted, tried
        tried = tried ^ _fits_turned(views, adjusted, tried, middle)
    return best, member


def _least_with_board(
    points: Correspondences, views: Views, member: NDArray[np.bool_], adjusted: Adjusted, skew: bool
) -> float:
    """Squared error [px^2] with some views turned back, and the board estimated with the camera.

    `views` are turned already, and the points are not.
    """
    from neurocal_cli.adjustment.board.find import find_target

    those = np.isin(np.array(points.view_names), np.array(views.names)[member])[points.view_index]
    back = np.array(points.image_size) - 1 - points.pixels
    points = replace(points, pixels=np.where(those[:, None], back, points.pixels))
    problem = problem_for(points, 1, skew=skew, distortion=Distortion(adjusted.state.model))
    found = find_target([(replace(problem, views=views), adjusted)])
    if found is None:
        return float(adjusted.cost.sum()) * views.pixel_scale**2
    problem, adjusted = found.fits[0]
    return float(adjusted.cost.sum()) * problem.views.pixel_scale**2


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
