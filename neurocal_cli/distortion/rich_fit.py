"""A rich lens: a fisheye and a smooth displacement, of which there is as much as the points ask for.

The displacement's nodes w (see `rich_lens`) have a Gaussian prior. With the noise's variance as the unit,
adjusting minimises

    E = |r|^2 + sum_i lambda_i w^T K_i w,    lambda_i = sigma^2 / size_i^2,

where two parts K_i hold the bending energy of the profile and of the field, and two their squares: the
first lets the points fill the gaps between them, the second lets what no point tells stay 0 but for its size.
Such a prior is a Matern process (Lindgren, Rue and Lindstrom 2011). MacKay's (1992) steps find the sizes from
the evidence: with the Hessian H of E and P = sum_i lambda_i K_i,

    gamma_i = lambda_i tr((P^-1 - H^-1) K_i),    lambda_i <- gamma_i sigma^2 / (w^T K_i w).

What A, k1 to k4 and the turns of all poses can do by themselves is held out of w, over the points seen, so
that these parameters mean what they mean for a fisheye. The prior is a part of the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.bundle_adjustment.cross_validation import reduced
from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.reprojection import POSE, CameraState, camera_columns, normal_blocks
from neurocal_cli.bundle_adjustment.reweighting import reweighted
from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.rich_lens import FIRST_NODE, GRID, NODES, RADII, REACHES
from neurocal_cli.geometry import Array, cross_matrix
from neurocal_cli.least_squares.normal_equations import solve_scaled

__all__ = ["with_displacement"]

_N = len(NODES)
_NODES = slice(5 + FIRST_NODE, 5 + FIRST_NODE + _N)  # of the shared parameters, which begin with A's entries
_COLUMNS = np.arange(_N) + POSE.stop + FIRST_NODE  # of normal matrices
_MARGIN = 1.05  # of the reach, beyond the points or the image's corners
_FARTHER = 1.5  # than the points: the largest reach
_START = np.array([1.0, 10.0, 1.0, 10.0])  # sizes, in rms residuals
_LARGEST, _SMALLEST = 1e3, 1e-4  # sizes, likewise
_HELD = 1e-2  # size of what is held out, likewise
_TINY, _SAME = 1e-300, 1e-6
_NO_GAIN = 0.02  # of the logarithm of the evidence
_LEAST_GAMMA, _LONGEST = 1e-6, 1.0  # of a step, in logarithms of the sizes
_ROUNDS, _PASSES = 4, 60
_SETTLED, _NEARLY = 0.02, 0.1  # relative changes of the sizes, within a round and between rounds


def with_displacement(solution: Solution) -> Solution:
    """Fit a rich lens, beginning with a fisheye or with a rich lens.

    Parameters
    ----------
    solution : Solution
        At the minimum, or near it.

    Returns
    -------
    Solution
        Its problem has the prior as the restraint; `shared` is the covariance with the prior.
    """
    problem = solution.problem.with_model("rich")
    problem = replace(problem, fixed=problem.fixed | set(REACHES))
    state = solution.state
    if state.model != "rich":
        k = np.concatenate([state.k, _reaches(problem, state), np.zeros(_N)])
        state = replace(state, model="rich", k=k)
    start = replace(solution, problem=problem, adjusted=replace(solution.adjusted, state=state), shared=None)
    solution = _by_evidence(start)
    if problem.points.covariance is not None:
        solution = _by_evidence(reweighted(solution))
    return solution


def _reaches(problem: Problem, state: CameraState) -> Array:
    """Of the points, and of the image's border unless that is much farther out: |s|, |sx| and |sy|."""
    views = problem.views
    seen = (state.R[views.index] @ views.local[..., None])[..., 0] + state.t[views.index]
    far, border = _extent(seen), np.zeros(3)
    if problem.points.image_size is not None:
        u, v = ((side - 1) * np.array([0.0, 0.5, 1.0]) for side in problem.points.image_size)
        camera = Camera(Intrinsics.from_matrix(problem.matrix(state.entries[0])), state.distortion)
        rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
        border = _extent(rays[np.isfinite(rays[:, 0])])
    return np.asarray(_MARGIN * np.clip(border, far, _FARTHER * far))


def _extent(directions: Array) -> Array:
    """Largest |s|, |sx| and |sy| of directions (N, 3)."""
    s = directions[:, :2] / (np.linalg.norm(directions, axis=1) + directions[:, 2])[:, None]
    return np.abs(np.column_stack([np.hypot(*s.T), s])).max(axis=0, initial=0.0)


@dataclass(frozen=True, eq=False)
class _Prior:
    """The restraint: rows of which the squares, of the nodes, are added to those of the residuals."""

    rows: Array

    def __call__(self, state: CameraState) -> tuple[Array, Array]:
        """Derivatives (m, 5 + K) and what is missing (m,)."""
        by_camera = np.zeros((len(self.rows), 5 + len(state.k)))
        by_camera[:, _NODES] = self.rows
        return by_camera, -self.rows @ state.k[FIRST_NODE:]


def _by_evidence(solution: Solution) -> Solution:
    """Adjust, and find the sizes anew, until they stay."""
    problem, adjusted = solution.problem, solution.adjusted
    normal, _ = normal_blocks(problem.views.batches, adjusted.state)
    held = _held_out(problem, adjusted.state, normal)
    parts = _parts()
    scale = np.sqrt(normal[:, -1, -1].sum() / problem.views.n_equations) / adjusted.state.entries[0, 0]
    sizes = _START * scale
    found = None
    for _ in range(_ROUNDS):
        before = sizes if found is None else found.sizes
        found = _sizes(problem, adjusted.state, normal, parts, held, before, scale)
        rows = np.asarray(np.linalg.cholesky(found.precision).T, dtype=float)
        problem = replace(problem, restraint=_Prior(rows))
        adjusted = problem.adjust(replace(adjusted, state=adjusted.state))
        normal = adjusted.normal
        if np.abs(np.log(found.sizes / before)).max() < _NEARLY:
            break
    assert found is not None
    last = _sizes(problem, adjusted.state, normal, parts, held, found.sizes, scale, learn=False)
    return replace(
        solution, problem=problem, adjusted=adjusted, shared=last.covariance, by_prior=_N - last.determined
    )


@dataclass(frozen=True, eq=False)
class _Found:
    """Sizes of the parts, and what follows from them.

    Attributes
    ----------
    sizes : (4,) array
        In units of x'.
    precision : (n, n) array
        P, of the nodes, in units of the residuals' squares.
    covariance : (f, f) array
        Of the free shared parameters.
    determined : float
        How many of the nodes' unknowns the points determine.
    """

    sizes: Array
    precision: Array
    covariance: Array
    determined: float


def _sizes(
    problem: Problem, state: CameraState, normal: Array, parts: list[Array], held: Array,
    sizes: Array, scale: float, learn: bool = True,
) -> _Found:  # fmt: skip
    """MacKay's steps on the quadratic around a state; or what follows from sizes that are known."""
    free = problem.free_camera
    q = reduced(normal, free, problem.free_poses)
    S, g, cost = q.S.sum(axis=0), q.g.sum(axis=0), float(q.cost.sum())
    w = state.k[FIRST_NODE:]
    nodes = slice(len(g) - _N, None)
    spare = problem.views.n_equations - problem.n_parameters
    determined = 0.0
    variance = cost / max(spare, 1)
    for _ in range(_PASSES):
        strength = variance / sizes**2
        P = held * (variance / (_HELD * scale) ** 2) + sum(
            s * K for s, K in zip(strength, parts, strict=True)
        )
        H, right = S.copy(), g.copy()
        H[nodes, nodes] += P
        right[nodes] -= P @ w
        inverse, prior = solve_scaled(H, np.eye(len(H))), solve_scaled(P, np.eye(_N))
        step = inverse @ right
        after = w + step[nodes]
        free = strength * [(prior * K).sum() for K in parts]
        gamma = np.maximum(free - strength * [(inverse[nodes, nodes] * K).sum() for K in parts], _LEAST_GAMMA)
        determined = float(gamma.sum())
        last, variance = variance, (cost - 2 * g @ step + step @ S @ step) / max(spare - determined, 1)
        # MacKay's step, longer for parts of which the data determine little, where it would be too short.
        wanted = np.log([after @ K @ after for K in parts] / gamma / sizes**2)
        change = np.clip(wanted * (1 - 0.5 * gamma / free), -_LONGEST, _LONGEST) * learn
        new = np.clip(sizes * np.exp(change), _SMALLEST * scale, _LARGEST * scale)
        change = np.abs(np.log(new / sizes))
        gain = float((gamma * np.abs(np.expm1(wanted)) * change).sum())  # of the evidence's logarithm
        settled = (change.max() < _SETTLED or gain < _NO_GAIN) and abs(np.log(variance / last)) < _SETTLED
        sizes = new
        if settled:
            break
    return _Found(sizes, P, variance * inverse, determined)


def _parts() -> list[Array]:
    """(n, n) matrices: bending and squares of the profile, bending and squares of the field.

    The field's bending is of third order, the sum of squared third derivatives: beyond the points it goes on
    with the curvature that it has there, and the band is as wide as that is uncertain.
    """
    profile = np.diff(np.eye(RADII + 1), 2, axis=0)[:, 1:]  # the node on the axis is 0
    one = np.eye(GRID)
    first, second, third = (np.diff(one, order, axis=0) for order in (1, 2, 3))
    mixed = np.concatenate([np.kron(first, second), np.kron(second, first)])
    field = np.concatenate([np.kron(one, third), np.kron(third, one), np.sqrt(3) * mixed])
    bending, squares = np.kron(np.eye(2), field.T @ field), np.eye(2 * GRID * GRID)
    parts = []
    for at, block in ((0, profile.T @ profile), (0, np.eye(RADII)), (RADII, bending), (RADII, squares)):
        whole = np.zeros((_N, _N))
        whole[at : at + len(block), at : at + len(block)] = block
        parts.append(whole)
    return parts


def _held_out(problem: Problem, state: CameraState, normal: Array) -> Array:
    """(n, n) projection of the nodes on what other parameters can do, over the points that are seen."""
    # The camera's entries and coefficients, where they are free.
    others = camera_columns(len(state.k))[np.flatnonzero(problem.free_camera)][:-_N]
    rows = [normal[:, others[:, None], _COLUMNS].sum(axis=0)]
    if problem.free_poses:
        # All poses turn about the camera: tau follows omega as omega x t.
        by_omega, by_tau = np.split(normal[:, POSE][:, :, _COLUMNS], 2, axis=1)
        turns = by_omega + cross_matrix(state.t) @ by_tau
        rows.append(turns.sum(axis=0))
    stacked = np.concatenate(rows)
    stacked /= np.linalg.norm(stacked, axis=1, keepdims=True) + _TINY
    _, values, axes = np.linalg.svd(stacked, full_matrices=False)
    axes = axes[values > _SAME * values[0]]
    return np.asarray(axes.T @ axes)
