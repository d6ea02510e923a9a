"""Stage 1: each view's network learns its product W V from random weights, and all tell a lens's distortion.

The networks model a pinhole. A bent lens leaves errors in them that are alike in all views, and these errors
tell its distortion before there is a camera. Undistortion by

    m_u = c + (m - c) (1 + kappa_1 s + kappa_2 s^2),  s = |m - c|^2 / r^2,

where c is the given image centre or the mean of all pixels, and r the distance of the farthest, is linear in
the two numbers. One Gauss-Newton step from the trained products W V, in the numbers and all products at once,
finds most lenses well enough: bundle adjustment starts near its minimum instead of at a pinhole.
`radial_networks` searches for stronger distortions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import Arrowhead
from neurocal_cli.adjustment.problem import Problem, intrinsic_matrix
from neurocal_cli.adjustment.solution import TrainingRecord
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.network.levenberg_marquardt import NormalEquations
from neurocal_cli.network.network import Patterns, Task, patterns_of
from neurocal_cli.network.options import MOST_POINTS, Options
from neurocal_cli.network.starts import learn

# Largest eigenvalue of the product's normal matrix, relative to the largest of all, that counts as 0.
_NO_CONDITION = 1e-13
_SMALL = 1500  # number of patterns below which subsampling saves no time (test_speed.py)
_RIDGE = 1e-9  # share of the diagonal; without it the free scale of a product makes its matrix singular
_STRONGEST = 0.5  # largest change of the farthest point's radius for which one step is near enough
_RADII = np.linspace(0.02, 1.0, 60)  # of the points, at which the coefficients of a model are fitted


@frozen_dataclass(eq=False)
class Group:
    """Views of one kind, flat or solid, with their trained networks."""

    views: NDArray[np.intp]  # (K,) indices
    flat: bool
    product: Array  # (K, 3, I) W V; for flat views in the coordinates of the view's own plane
    bound: Array  # (K,) squared pixel error of the free networks, a lower bound for that of any camera
    patterns: Patterns | None = None  # on which they were trained, at most `MOST_POINTS` of each view


def begin_flat(problem: Problem) -> NDArray[np.bool_]:
    """(V,) which views' networks treat their target as a plane.

    With other views or given intrinsics, a nearly flat target is best treated as flat at first; bundle
    adjustment uses all its coordinates.
    """
    views = problem.views
    helped = views.n_views > 1 or problem.type == 3
    return views.nearly_flat if helped else views.exactly_flat


def train_networks(
    problem: Problem, options: Options, rng: np.random.Generator, which: NDArray[np.bool_]
) -> tuple[list[Group], TrainingRecord]:
    """Train the networks of some views (V,) from random weights, flat and solid targets separately."""
    options.progress("training the networks", 0.0)
    views, begins_flat = problem.views, begin_flat(problem)
    groups, record = [], TrainingRecord.empty(views.n_views)
    W = _given_weights(problem)
    for flat in (True, False):
        members = np.flatnonzero(which & (begins_flat == flat))
        if not members.size:
            continue
        every = patterns_of(views, members, flat, MOST_POINTS)
        small = every.weights.size <= _SMALL
        most = options.start_points[0 if flat else 1]
        some = every if small else patterns_of(views, members, flat, most, rng)
        learnt = learn(some, options.trainer, rng, options.starts, options.agreement, W=W)
        iterations = learnt.iterations
        if options.finish is not None and not small:
            free = np.ones((3, 3), dtype=bool), np.ones((3, every.n_inputs), dtype=bool)
            trained = options.finish(Task(every, learnt.W, learnt.V, *free))
            learnt = replace(learnt, W=trained.W, V=trained.V, rms=every.rms(trained.loss))
            iterations += int(trained.iterations.sum())
        record = replace(
            record.with_starts(members, learnt.agreed, int(learnt.starts.sum()), iterations),
            squares=record.squares + float((learnt.rms**2 * views.counts[members]).sum()),
            curve=learnt.curve if members[0] == 0 else record.curve,
        )
        bound = _pixel_error(problem, members, flat, learnt.product, every)
        groups.append(Group(members, flat, learnt.product, bound, every))
    options.progress("training the networks", 1.0)
    return groups, record


def refuse_few_conditions(problem: Problem, groups: Sequence[Group]) -> None:
    """Refuse a single view whose points lie nearly all in one plane: raise DegenerateGeometryError.

    Any number of points of a plane gives 8 conditions on the product W V, and each point off the plane 2
    more, up to 11. With no more conditions than unknowns, other cameras fit equally well.
    """
    if problem.views.n_views > 1 or groups[0].flat:
        return
    patterns = patterns_of(problem.views, np.array([0]), False, MOST_POINTS)
    product = groups[0].product
    normal = NormalEquations(patterns, np.ones(product.shape[1:], dtype=bool))
    matrix = normal(product / np.linalg.norm(product), 0.0, np.array([0]))[2]
    values = np.linalg.eigvalsh(matrix[0])
    conditions = int((values > _NO_CONDITION * values[-1]).sum())
    unknowns = int(problem.free.sum()) + 6
    if conditions < 11 and conditions <= unknowns:
        raise DegenerateGeometryError(
            f"view {problem.views.names[0]!r}: nearly all points lie in one plane, which gives {conditions} "
            f"conditions for {unknowns} unknowns; give more points off the plane, or known parameters "
            "(--type 2, --no-skew)"
        )


def _given_weights(problem: Problem) -> Array | None:
    """W as far as the problem type gives it, nan elsewhere; for trainers that move W and V themselves."""
    if problem.type == 1:
        return None
    if problem.type == 3:
        return intrinsic_matrix(problem.normalised_entries)
    W = np.full((3, 3), np.nan)
    W[:2, 2] = problem.normalised_entries[3:]
    return W


def _pixel_error(
    problem: Problem, members: NDArray[np.intp], flat: bool, product: Array, every: Patterns
) -> Array:
    """Squared pixel error of each view's free network over all its points; (K,)."""
    counts = problem.views.counts[members]
    if counts.max() <= every.weights.shape[1]:
        return _squared_error(product, every)
    # The patterns of a large view are a subsample, but the bound must cover all of its points.
    total = np.empty(len(members))
    for k, count in enumerate(counts):
        whole = patterns_of(problem.views, members[k : k + 1], flat, int(count))
        total[k] = _squared_error(product[k : k + 1], whole)[0]
    return total


def _squared_error(product: Array, patterns: Patterns) -> Array:
    o = patterns.inputs @ np.swapaxes(product, 1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = ((o[..., :2] / o[..., 2:] - patterns.targets[..., :2]) ** 2).sum(-1)
    return np.where(patterns.weights > 0, patterns.weights * error, 0.0).sum(axis=1)


@frozen_dataclass(eq=False)
class RadialStep:
    """Networks after one step together with a radial distortion that they share."""

    groups: tuple[Group, ...]
    strength: Array  # (2,) kappa_1 and kappa_2
    reach: float  # r in normalised pixels

    def bent(self, state: CameraState, model: str) -> CameraState:
        """The pinhole camera of these networks with the distortion as coefficients of a model."""
        distorted = _RADII * self.reach / float(np.sqrt(state.entries[0, 0] * state.entries[0, 2]))
        k, _ = radial_coefficients(model, distorted * even_polynomial(self.strength, _RADII**2), distorted)
        return replace(state, model=model, k=k)


def radial_step(problem: Problem, groups: Sequence[Group]) -> RadialStep | None:
    """The step; None if no distortion is estimated, or if the step is not determined or too long."""
    group, views, patterns = groups[0], problem.views, groups[0].patterns
    if not problem.free_distortion or patterns is None or views.rays is not None:
        return None
    if len(groups) > 1:  # boards and solid targets together have products of two sizes
        return None
    Z, pixels = np.swapaxes(patterns.inputs, 1, 2), np.swapaxes(patterns.targets[..., :2], 1, 2)
    K, inputs, n = Z.shape
    own = np.arange(3 * inputs)
    centre = np.zeros(2)
    if problem.given_centre is not None:
        centre = (problem.given_centre - views.pixel_centre) / views.pixel_scale
    from_centre = pixels - centre[:, None]
    square = (from_centre * from_centre).sum(axis=1)
    reach = float(np.sqrt(square.max()))
    share = (square / reach**2)[:, None]
    o = group.product @ Z
    by_o = Z / o[:, 2:]
    predicted = o[:, :2] / o[:, 2:]
    # Derivatives of the pixels by the rows of the product, those by the numbers, and the residuals.
    J = np.zeros((K, len(own) + 3, 2, n))
    J[:, :inputs, 0] = J[:, inputs : 2 * inputs, 1] = by_o
    J[:, 2 * inputs : -3] = -by_o[:, :, None] * predicted[:, None]
    np.multiply(from_centre, -share, out=J[:, -3])
    np.multiply(J[:, -3], share, out=J[:, -2])
    np.subtract(pixels, predicted, out=J[:, -1])
    rows = (J * np.sqrt(patterns.weights)[:, None, None]).reshape(K, len(own) + 3, -1)
    normal = Arrowhead.of(rows @ np.swapaxes(rows, 1, 2), len(own) + np.arange(2), own)
    strength, by_product, _ = normal.step(_RIDGE)
    if not np.isfinite(by_product).all() or not np.abs(strength).sum() < _STRONGEST:
        return None
    if 1 + strength @ [3.0, 5.0] <= 0:  # the undistorted radius decreases before the farthest point
        return None
    moved = replace(group, product=group.product + by_product.reshape(K, 3, inputs))
    return RadialStep((moved,), strength, reach)


def radial_coefficients(model: str, straight: Array, distorted: Array) -> tuple[Array, float]:
    """Coefficients (K,) of a model that turns radii of a pinhole into distorted ones, and the largest error.

    They are fitted by least squares. Those that are not radial, and those of a denominator, are 0.
    """
    names, fisheye = coefficient_names(model), model == "fisheye"
    # k4 of other models is one of the denominator.
    radial = [n for n, name in enumerate(names) if name in ("k1", "k2", "k3") or fisheye]
    argument = np.arctan(straight) if fisheye else straight
    powers = argument[:, None] ** np.arange(3, 2 * len(radial) + 3, 2)
    k = np.zeros(len(names))
    k[radial] = np.linalg.lstsq(powers, distorted - argument, rcond=1e-6)[0]
    return k, float(np.abs(powers @ k[radial] - (distorted - argument)).max())


def even_polynomial(strength: Array, share: Array) -> Array:
    """The factor 1 + strength[0] s + strength[1] s^2, given squared radii s in units of the squared reach."""
    return np.asarray(1 + share * (strength[0] + strength[1] * share))
