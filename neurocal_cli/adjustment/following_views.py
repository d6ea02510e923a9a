"""Views that follow each other, as frames of a video do, and whose points have the same errors.

What shifts a point in one frame, such as its place between the pixels, shifts it in the next one, too. Such
views are worth fewer independent ones. If rho_l is the correlation of a point's residuals in views that are l
apart, and J_v are the derivatives of the residuals of view v by the camera's parameters, with its pose
projected out, the variance of a parameter is that of independent views times

    1 + 2 sum_l rho_l sum_v J_v . J_(v+l) / sum_v J_v . J_v,

which is less than the sum of the correlations if the target moves. A bent board or a lens that is too simple
displaces neighbouring points alike, and also does so in the next view. So the correlation is that of what no
smooth field over the target explains, and only what exceeds that of views far apart counts: the board's
points may be elsewhere than stated.
"""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.reprojection import POSE, camera_columns, derivatives
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.geometry import Array, distinct_rows
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.measured_directions import measured_part

_FEWEST = 15  # views, and points of the target: fewer do not tell such a correlation from noise
_VIEWS, _POINTS = 200, 50  # most views, and points of the target, that are used: they tell enough
_CERTAIN = 5.0  # standard deviations of a correlation that is chance
_LEAST = 0.3  # least correlation: photographs of paper boards, which bend, have up to 0.25
_NO_MORE = 2.0  # the same standard deviations for the last one that counts
_GONE = 0.1  # correlation of views that count as independent
_PER_COEFFICIENT = 4  # points for each coefficient of the smooth field
_FLAT = 1e-10  # relative size below which a column is rounding


def following_views(
    views: Views, state: CameraState, errors: Array, pose: NDArray[np.intp]
) -> tuple[int, float]:
    """Number of views until one is independent, and variance of a parameter over that of independent views.

    Both are 1 if views that follow each other are independent.

    `errors` (N, 2) are the normalised residuals in the order of the views' points, `state` is normalised, and
    `pose` (V,) is the number of each view's pose: views of one pose are no evidence.
    """
    if views.n_views > _VIEWS:
        views = views.subset(np.arange(_VIEWS))
        errors = errors[: len(views.index)]
    V = views.n_views
    if V < _FEWEST or not np.isfinite(errors).all():
        return 1, 1.0
    errors = measured_part(errors, views.across)
    label = distinct_rows(np.round(views.world / (1e-6 * views.scale[0])))[1]
    count = np.bincount(label)
    if np.count_nonzero(count > V // 2) < _FEWEST:
        return 1, 1.0
    used = np.argsort(-count, kind="stable")[:_POINTS]
    place = np.full(len(count), -1)
    place[used] = np.arange(len(used))
    kept = place[label] >= 0
    index = views.index[kept], place[label[kept]]
    seen, dense, local = (np.zeros((V, len(used), n)) for n in (1, 2, 3))
    seen[index], dense[index], local[index] = 1.0, errors[kept], views.local[kept]
    rough = _rough(dense, seen, local)
    if not _correlations(rough, seen, pose):
        return 1, 1.0
    of_camera, of_places = _derivatives(views.of_points(kept), state)
    J, by_place = np.zeros((V, len(used), *of_camera.shape[1:])), np.zeros((V, len(used), 2, 3))
    J[index], by_place[index] = of_camera, of_places
    rho = _correlations(_without_offsets(rough, by_place), seen, pose)
    if not rho:
        return 1, 1.0
    own = (J**2).sum(axis=(0, 1, 2))
    shared = sum(2 * r * (J[:-n] * J[n:]).sum(axis=(0, 1, 2)) for n, r in enumerate(rho, 1))
    variance = max(1.0 + float((shared[own > 0] / own[own > 0]).mean()), 1.0)
    return 1 + sum(r > _GONE for r in rho), variance


def _rough(errors: Array, seen: Array, local: Array) -> Array:
    """(V, P, 2) errors of each view without a smooth field over its points at (V, P, 3).

    `seen` (V, P, 1) is 1 for points that a view has, else 0, and so are their errors.
    """
    x = np.moveaxis(local, 2, 0)
    fields = [seen[:, :, 0], *x]
    for degree in (2, 3):
        fields += [
            np.prod(x[list(factors)], axis=0) for factors in combinations_with_replacement(range(3), degree)
        ]
    fields = [field for field in fields if np.abs(field).max() > _FLAT]
    D = np.stack(fields[: max(int(np.median(seen.sum(axis=1))) // _PER_COEFFICIENT, 1)], axis=2)
    across = np.swapaxes(D, 1, 2)
    smooth = D @ np.linalg.solve(_regular(across @ D), across @ errors)
    return np.asarray((errors - smooth) * seen)


def _correlations(errors: Array, seen: Array, pose: NDArray[np.intp]) -> list[float]:
    """Correlations of a point's errors in views that are 1, 2, ... apart; none if the first may be chance.

    They are what exceeds the correlation of views that are more than half of all views apart.
    """
    half = len(errors) // 2
    power = float((errors**2).sum()) / (2 * float(seen.sum()))
    later = [np.cumsum(part[::-1], axis=0)[::-1][half:] for part in (errors, seen)]
    far = float((errors[:-half] * later[0]).sum()) / max(2 * float((seen[:-half] * later[1]).sum()), 1.0)
    found: list[float] = []
    for n in range(1, half):
        other = (pose[n : len(seen)] != pose[: len(seen) - n])[:, None, None]
        number = 2 * float((seen[:-n] * seen[n:] * other).sum())
        product = float((errors[:-n] * errors[n:] * other).sum())
        limit = max(_CERTAIN * np.sqrt(number), _LEAST * number) if n == 1 else _NO_MORE * np.sqrt(number)
        if not product - far * number > power * limit:
            break
        found.append((product / number - far) / (power - far))
    return found


def _without_offsets(errors: Array, by_place: Array) -> Array:
    """(V, P, 2) errors without those that an offset of each point on the target explains in all views.

    `by_place` (V, P, 2, 3) are the derivatives of the residuals by the points' places.
    """
    J = np.swapaxes(by_place, 0, 1).reshape(errors.shape[1], -1, 3)
    own = np.swapaxes(errors, 0, 1).reshape(len(J), -1, 1)
    across = np.swapaxes(J, 1, 2)
    left = own - J @ np.linalg.solve(_regular(across @ J), across @ own)
    return np.asarray(np.swapaxes(left.reshape(len(J), -1, 2), 0, 1))


def _derivatives(views: Views, state: CameraState) -> tuple[Array, Array]:
    """Derivatives of the residuals by the camera's parameters and by the points' places on the target.

    The former (N, 2, 5 + K) have the poses projected out, the latter are (N, 2, 3).
    """
    batches, K = views.batches, state.k.shape[-1]
    out = np.zeros((len(batches.view), 12 + K, 2, batches.local.shape[2]))
    for chunk in batches.chunks():
        derivatives(batches, chunk, state, out[chunk])
    J = out.transpose(0, 3, 2, 1).reshape(len(out), -1, 12 + K)
    camera, poses = J[:, :, camera_columns(K)], J[:, :, POSE]
    across = np.swapaxes(poses, 1, 2)
    camera -= poses @ np.linalg.solve(_regular(across @ poses), across @ camera)
    R = state.R[batches.view] / views.scale[batches.view][:, None, None]
    of_camera = camera.reshape(len(out), -1, 2, 5 + K)[views.index, views.rank]
    of_places = (poses[:, :, 3:] @ R).reshape(len(out), -1, 2, 3)[views.index, views.rank]
    return np.asarray(of_camera), np.asarray(of_places)


def _regular(normal: Array) -> Array:
    """Normal matrices (V, n, n) that can be solved even if some columns are alike."""
    n = normal.shape[-1]
    return np.asarray(normal + (_FLAT * np.trace(normal, axis1=1, axis2=2))[:, None, None] * np.eye(n))
