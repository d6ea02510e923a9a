"""Fit a rich lens: a fisheye plus a smooth displacement with a Gaussian-process prior.

The nodes w of the displacement (see `rich_lens`) have a Gaussian prior: its profile and its field are sums of
Gaussian processes of different lengths. For a process of length l and size s, nodes at the distance d have
the covariance s^2 exp(-d^2 / (2 l^2)); the profile is odd. Without points, the displacement has the prior
variance. k1 to k4 have a prior of the size of real lenses, so that the fisheye extrapolates like a lens. A
has no prior; its standard deviation contains its correlation with the displacement.

The sizes maximise the evidence (empirical Bayes, MacKay 1992). Let P be the inverse of the prior covariance
C = sum_j s_j^2 C_j, and S the posterior covariance of w. Then

    gamma_j = s_j^2 tr(C_j (P - P S P)),    s_j^2 <- s_j^4 (w^T P C_j P w) / gamma_j.

A wide lognormal prior bounds sizes that the points do not determine. The covariance includes the prior.

Among the points, these determine the profile g. Farther out its prior dominates, whose sizes may be poorly
determined: if a polynomial fits the profile among the points, the most probable sizes are small, but larger
ones are not much less probable. So the covariance is averaged over the sizes of the profile. Let w_m be the
posterior weight of the m-th sizes, P_m and g_m the posterior covariance and mean of g for them, g the
reported profile, and T = dc/dg the response of all other unknowns c. Then

    E = sum_m w_m (P_m + (g_m - g) (g_m - g)^T),    cov(c, g) = cov(c, g | g) + [T; 1] E [T; 1]^T

is the result of Bayesian model averaging (Hoeting et al. 1999) around the reported parameters.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import numpy as np

from neurocal_cli.adjustment.common_noise import reweighted
from neurocal_cli.adjustment.cross_validation import Minimum, held_out_views, reduced
from neurocal_cli.adjustment.normal_equations import unit_diagonal
from neurocal_cli.adjustment.open_choices import averaged, fisheye_sizes
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.rich_lens import FIRST_NODE, GRID, NODES, RADII, REACHES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError

_N = len(NODES)
# Indices of k1 to k4 and the nodes among the coefficients; and the parts of these unknowns.
_UNKNOWNS = np.r_[:4, FIRST_NODE : FIRST_NODE + _N]
_PROFILE, _FIELD_X, _FIELD_Y = (slice(4 + a, 4 + b) for a, b in pairwise((0, RADII, RADII + GRID**2, _N)))
_MARGIN = 1.05  # reach over the extent of the points or of the image's border
_FARTHER = 1.5  # largest reach over the extent of the points
_TINY, _NOTHING, _NEWTON = 1e-300, 1e-17, 8
# Lengths of the processes, in reaches, and bounds of their sizes, in rms residuals of the fisheye. Repeated
# by test_rich_lens.py (slow): with these, errors in parts without points match their standard
# deviations.
_OF_PROFILE, _OF_FIELD = (0.1, 0.25), (0.25, 0.5, 1.0)
_LARGEST, _SMALLEST, _SPREAD = 10.0, 1e-3, 1.5  # the last one is the prior std of the logarithm
_LIKE_NOTHING, _SIZES = 1e-2, 10  # smallest size in the average over the profile's sizes, and their number
_ROUGH = 2e-3  # size of an additional white-noise process, in the same unit
_LONGEST = 1.0  # longest step, in logarithms of the sizes
_AT_FIRST, _EASED = 4, 0.7  # number of passes with full steps, and damping of later ones against oscillation
_ROUNDS, _PASSES = 4, 40
_NO_GAIN, _SETTLED = 0.05, 0.02  # passes end below this gain in log evidence and this change of the variance
_NEARLY = 0.1  # change of the log evidence that ends the rounds


def with_displacement(solution: Solution) -> Solution:
    """Fit a rich lens, starting from a fisheye or a rich lens at the minimum, or near it.

    The penalty of the resulting problem is the prior; `shared` is the covariance with the prior. Raises
    `DegenerateGeometryError` if no fisheye is near the lens, so that the displacement is not determined.
    """
    try:
        solution = _by_evidence(_begun(solution))
        if solution.problem.points.covariance is not None:
            solution = _by_evidence(reweighted(solution))
    except np.linalg.LinAlgError as error:
        raise DegenerateGeometryError(
            "no fisheye with a smooth displacement fits these points; choose --distortion auto, and give "
            "images as the camera has recorded them, not stretched or stabilised"
        ) from error
    return solution


def promised(solution: Solution, repeated: RepeatedPoses) -> Array:
    """Predicted squared error (V,) of held-out views with a rich lens, without adjusting one.

    The solution is a fisheye, at the minimum. Views of one pose are held out together.
    """
    solution = _begun(solution)
    problem, state = solution.problem, solution.state
    normal, _ = normal_blocks(problem.views.batches, state)
    processes, sizes = _beginning(problem, state, normal)
    found = _sizes(problem, state, normal, processes, sizes)
    free = problem.free_camera
    others = int(free.sum()) - len(_UNKNOWNS)
    held = np.pad(found.precision, (others, 0))
    missing = np.pad(-found.precision @ state.k[_UNKNOWNS], (others, 0))
    m = Minimum(problem.views, state, normal, free, problem.free_poses, repeated)
    return held_out_views(m, (held, missing))


def _begun(solution: Solution) -> Solution:
    """The solution as a rich lens: with zero displacement, unless it has one."""
    if solution.state.model == "rich":
        return replace(solution, shared=None)
    problem = solution.problem.with_model("rich")
    problem = replace(problem, fixed=problem.fixed | set(REACHES))
    k = np.concatenate([solution.state.k, _reaches(problem, solution.state), np.zeros(_N)])
    state = replace(solution.state, model="rich", k=k)
    return replace(solution, problem=problem, adjusted=replace(solution.adjusted, state=state), shared=None)


def _reaches(problem: Problem, state: CameraState) -> Array:
    """Largest |s|, |sx| and |sy| of the points and of the image's border, unless that is much farther out."""
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


@frozen_dataclass(eq=False)
class _Prior:
    """The prior of k1 to k4 and the nodes, a `Penalty`."""

    rows: Array  # (n, n) square root of the precision: extra residuals of k1 to k4 and the nodes
    sizes: Array  # of the processes, in units of x'
    scale: float  # rms residual of the fisheye, in the same unit

    def __call__(self, state: CameraState) -> tuple[Array, Array]:
        """Jacobian (m, 5 + K) and residuals (m,)."""
        by_camera = np.zeros((len(self.rows), 5 + len(state.k)))
        by_camera[:, 5 + _UNKNOWNS] = self.rows
        return by_camera, -self.rows @ state.k[_UNKNOWNS]


def _by_evidence(solution: Solution) -> Solution:
    """Alternate between bundle adjustment and the estimation of the sizes until these converge."""
    problem, adjusted = solution.problem, solution.adjusted
    normal, _ = normal_blocks(problem.views.batches, adjusted.state)
    processes, sizes = _beginning(problem, adjusted.state, normal)
    found = _sizes(problem, adjusted.state, normal, processes, sizes)
    for _ in range(_ROUNDS):
        before = found.sizes
        rows = np.asarray(np.linalg.cholesky(found.precision).T, dtype=float)
        problem = replace(problem, penalty=_Prior(rows, before, processes.scale))
        adjusted = problem.adjust(adjusted)
        normal = adjusted.normal
        found = _sizes(problem, adjusted.state, normal, processes, before)
        if (found.gamma * np.abs(np.log(found.sizes / before))).max() < _NEARLY:
            break
    shared = _averaged(processes, found, adjusted.state.k[_UNKNOWNS])
    return replace(
        solution, problem=problem, adjusted=adjusted, shared=shared, by_prior=_N - found.determined
    )


def _averaged(processes: _Processes, found: _Found, x: Array) -> Array:
    """Covariance of the free shared parameters, averaged over the sizes of the profile's processes."""
    held = found.precision.copy()
    held[_PROFILE, _PROFILE] = 0.0
    first = len(found.g) - len(x)
    H = found.S + np.pad(held, (first, 0))
    right = found.g - np.pad(held @ x, (first, 0))
    profile = slice(first + _PROFILE.start, first + _PROFILE.stop)
    H, right = H / found.variance, right / found.variance
    return averaged_over_sizes(found.covariance, H, right, profile, x[_PROFILE], processes.profiles())


def averaged_over_sizes(
    covariance: Array, H: Array, right: Array, profile: slice, value: Array, priors: tuple[Array, Array]
) -> Array:
    """Covariance (f, f) of the shared parameters, averaged over the priors of the profile.

    `covariance` is that for one of the priors; H (f, f) and `right` (f,) are the precision, and the gradient
    at the reported values, without the profile's prior; `profile` are the places of the profile among the f
    parameters and `value` (n,) the reported one; `priors` are prior covariances (m, n, n) and the logarithms
    (m,) of their prior probabilities.
    """
    is_profile = np.zeros(len(H), dtype=bool)
    is_profile[profile] = True
    roots = np.asarray(np.linalg.cholesky(priors[0]), dtype=float)
    E, follow, *_ = averaged(H, right, is_profile, value, roots, priors[1])
    return np.asarray(covariance + follow @ (E - covariance[profile, profile]) @ follow.T)


def _beginning(problem: Problem, state: CameraState, normal: Array) -> tuple[_Processes, Array]:
    """The processes and their initial sizes."""
    reaches = state.k[FIRST_NODE - len(REACHES) : FIRST_NODE]
    if isinstance(problem.penalty, _Prior):
        return _processes(reaches, problem.penalty.scale), problem.penalty.sizes
    scale = float(np.sqrt(normal[:, -1, -1].sum() / problem.views.n_equations) / state.entries[0, 0])
    return _processes(reaches, scale), np.full(len(_OF_PROFILE) + len(_OF_FIELD), scale)


@frozen_dataclass(eq=False)
class _Processes:
    """The Gaussian processes of the prior."""

    profile: Array  # (p, n, n) covariances of processes of size 1
    field: Array  # (f, m, m) the same, for both directions
    of_fisheye: Array  # (4,) standard deviations of k1 to k4
    scale: float

    def inverses(self, sizes: Array) -> tuple[Array, Array]:
        """Inverse covariances of the profile and of the field, for given sizes of all processes."""
        rough, n = (_ROUGH * self.scale) ** 2, len(self.profile)
        both = (self.profile, sizes[:n] ** 2), (self.field, sizes[n:] ** 2)
        sums = [np.tensordot(s, C, axes=1) + rough * np.eye(C.shape[1]) for C, s in both]
        return _inverse(sums[0]), _inverse(sums[1])

    def profiles(self) -> tuple[Array, Array]:
        """Covariances of the profile for all combinations of sizes, and their log prior."""
        some = np.geomspace(_LIKE_NOTHING, _LARGEST, _SIZES)
        sizes = np.array(list(product(some, repeat=len(self.profile))))
        sums = np.tensordot(sizes**2, self.profile, axes=1) + _ROUGH**2 * np.eye(self.profile.shape[1])
        return self.scale**2 * sums, -0.5 * (np.log(sizes) ** 2).sum(axis=1) / _SPREAD**2


def _processes(reaches: Array, scale: float) -> _Processes:
    reach, *sides = reaches
    r = np.arange(1, RADII + 1) * reach / (RADII - 1)
    odd = np.array(
        [_alike(r[:, None] - r, n * reach) - _alike(r[:, None] + r, n * reach) for n in _OF_PROFILE]
    )
    along = [2 * side / (GRID - 3) * np.subtract.outer(np.arange(GRID), np.arange(GRID)) for side in sides]
    field = np.array([np.kron(_alike(along[1], n * reach), _alike(along[0], n * reach)) for n in _OF_FIELD])
    return _Processes(odd, field, fisheye_sizes(2 * float(np.arctan(reach))), scale)


def _alike(distance: Array, length: float) -> Array:
    alike = np.exp(-0.5 * (distance / length) ** 2)
    return np.where(alike < _NOTHING, 0.0, alike)  # denormal numbers are slow


@frozen_dataclass(eq=False)
class _Found:
    """Estimated sizes of the processes, with the resulting posterior.

    S and g are the quadratic model of the squared error around the state, with the poses eliminated.
    """

    sizes: Array  # of each process, in units of x'
    gamma: Array  # effective number of unknowns of each process that the points determine
    precision: Array  # (n, n) P, of k1 to k4 and the nodes, in units of the squared residuals
    covariance: Array  # (f, f) of the free shared parameters
    determined: float  # effective number of the nodes' unknowns that the points determine
    variance: float  # of the residuals
    S: Array  # (f, f)
    g: Array  # (f,)


def _sizes(
    problem: Problem, state: CameraState, normal: Array, processes: _Processes, sizes: Array
) -> _Found:
    """Estimate the sizes by MacKay's updates on the quadratic model around a state."""
    q = reduced(normal, problem.free_camera, problem.free_poses)
    S, g, cost = q.S.sum(axis=0), q.g.sum(axis=0), float(q.cost.sum())
    x = state.k[_UNKNOWNS]
    own = slice(len(g) - len(x), None)
    spare = problem.views.n_equations - problem.n_parameters
    variance, scale = cost / max(spare, 1), processes.scale
    for n_pass in range(_PASSES):
        of_profile, of_field = processes.inverses(sizes)
        P = np.zeros((len(x), len(x)))
        P[range(4), range(4)] = processes.of_fisheye**-2
        for part, block in ((_PROFILE, of_profile), (_FIELD_X, of_field), (_FIELD_Y, of_field)):
            P[part, part] = block
        H, right = S.copy(), g.copy()
        H[own, own] += variance * P
        right[own] -= variance * (P @ x)
        inverse = _inverse(H)
        step = inverse @ right
        covariance, w = variance * inverse[own, own], x + step[own]
        of_each = (
            _evidence(processes.profile, of_profile, w, covariance, (_PROFILE,)),
            _evidence(processes.field, of_field, w, covariance, (_FIELD_X, _FIELD_Y)),
        )
        num, den = np.concatenate(of_each, axis=1) * sizes**2
        determined = _N - float((P[4:, 4:] * covariance[4:, 4:]).sum())
        last, variance = variance, (cost - 2 * g @ step + step @ S @ step) / max(spare - determined, 1)
        change = np.clip(_change(num, den, np.log(sizes / scale)), -_LONGEST, _LONGEST)
        change *= 1.0 if n_pass < _AT_FIRST else _EASED
        if (den * np.abs(change)).max() < _NO_GAIN and abs(np.log(variance / last)) < _SETTLED:
            break
        sizes = np.clip(sizes * np.exp(change), _SMALLEST * scale, _LARGEST * scale)
    return _Found(sizes, den, last * P, last * inverse, determined, last, S, g)


def _evidence(
    covariances: Array, precision: Array, w: Array, after: Array, parts: tuple[slice, ...]
) -> Array:
    """(2, n) w^T P C_j P w and tr(C_j (P - P S P)) of each process; see the module's equations."""
    found = np.zeros((2, len(covariances)))
    for part in parts:
        a = precision @ w[part]
        left = precision - precision @ after[part, part] @ precision
        found += (covariances @ a) @ a, (covariances * left).sum(axis=(1, 2))
    return np.maximum(found, _TINY)


def _change(num: Array, den: Array, size: Array) -> Array:
    """Change d of the log sizes, by Newton's method: den - num exp(-2 d) + (size + d) / _SPREAD^2 = 0."""
    d = np.zeros_like(size)
    for _ in range(_NEWTON):
        rest = num * np.exp(-2 * d)
        f = den - rest + (size + d) / _SPREAD**2
        d -= np.clip(f / (2 * rest + _SPREAD**-2), -_LONGEST, _LONGEST)
    return d


def _inverse(H: Array) -> Array:
    """Inverse of a positive definite matrix, scaled to a unit diagonal."""
    scaled, scale = unit_diagonal(H)
    return np.asarray(np.linalg.inv(scaled) * np.outer(scale, scale))
