"""Score tests for a camera that changes between views, which need no new calibration.

Let one parameter of the camera, the logarithm of its focal length or of the image size, differ by delta_v in
view v. With S_v and g_v of each view (`cross_validation.reduced`), and the step a of the shared parameters
for delta = 1, the score of a view is s_v = a.g_v, and the covariance of the scores is

    M = diag(a.S_v a) - B S^-1 B^T,   B_v = S_v a,

in units of the noise variance. For a pattern c of views, delta_v = b c_v, the estimate is b = c.s / c.M c
with the standard deviation 1 / sqrt(c.M c). The patterns are: linear in the sequence of the views, in their
inverse distance and in the tilt of the target; a step at each place of the sequence; every other view; and
the two groups that differ most. The tests hold for small differences; `view_groups` finds larger ones.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.chi_squared import exceeded_by_chance
from neurocal_cli.adjustment.leave_out import Quadratics, inverse_or_nan
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState

# Repeated by test_view_change.py: on clean scenes there is less than one false alarm in a hundred, and
# on real boards, whose views differ by more than noise, none.
_LINE = 3.5  # sigmas: one false alarm in 2000 for each test
_BY_POSE = 4.0  # sigmas: poses differ in six ways, and lens errors are correlated with them
_MOST_BY_POSE = 0.1  # of the focal length: refocusing changes it by no more
_NEARER = 0.1  # least relative range of distances for a test of the focus
_TURNED = 0.2  # rad; least range of tilts
_STEP = 4.5  # sigmas of the largest of all steps
_SCATTER = 1.645  # sigmas: one false alarm in 20 for scatter of the other views
_FEWEST = 5  # fewest poses
# Critical values (1 in 1000) for the best split of V normal values into two groups: its chi-squared exceeds
# 2/pi V + 6.5 + 2.75 sqrt(V), and its share of the total 2/pi + 1.06 / sqrt(V). From 40,000 draws at V = 4 to
# 1000.
_MEAN, _TWO, _TWO_ROOT, _SHARE = 2.0 / np.pi, 6.5, 2.75, 1.06


@frozen_dataclass
class ViewChange:
    """A change of the camera between views.

    The amount is relative: from the first view to the last, from the farthest to the nearest, from the view
    turned most to the left (or upwards) to that turned most to the right (or downwards), or of the second
    group against the first. `views` is the second group; for the linear patterns all views, in their
    sequence.
    """

    what: str  # "focal length" or "image size"
    pattern: str  # "line", "distance", "tilt along u", "tilt along v", "step" or "groups"
    amount: float
    sigmas: float  # the amount in standard deviations
    explained: float  # share of the squared error that it explains
    views: tuple[str, ...]


def in_sequence(names: tuple[str, ...]) -> list[int]:
    """Indices that sort names in natural order, in which img2 comes before img10."""

    def key(place: int) -> list[tuple[bool, int, str]]:
        parts = re.findall(r"\d+|\D+", names[place])
        return [(not part[0].isdecimal(), int(part) if part[0].isdecimal() else 0, part) for part in parts]

    return sorted(range(len(names)), key=key)


def view_change(
    views: Views,
    state: CameraState,
    free: NDArray[np.bool_],
    scores: Quadratics,
    group: NDArray[np.intp],
    variance: float,
    spare: float,
) -> ViewChange | None:
    """Find the most significant change of the camera between views; None if there is none.

    The state is normalised, at the minimum, `variance` is that of its residuals, and `spare` are the
    equations beyond the unknowns. The scores are those of the poses (`view_covariance.scores_of_poses`), and
    `group` (V,) is the pose of each view (`repeated_poses`).
    """
    order = in_sequence(views.names)
    place = np.empty(len(order))
    place[order] = np.arange(len(order))
    place = np.bincount(group, place) / np.bincount(group)  # of each pose
    if len(place) < _FEWEST or not variance > 0:
        return None
    lines = {"line": place} | {
        name: np.bincount(group, values) / np.bincount(group) for name, values in _of_poses(views, state)
    }
    found: list[ViewChange] = []
    for what, step in directions(views, state, free):
        test = _ScoreTest.of(scores, step[free], variance)
        for pattern, members, amount, sigmas in _patterns(test, lines):
            names = tuple(views.names[k] for k in order if members[group[k]])
            found.append(ViewChange(what, pattern, amount, sigmas, sigmas**2 / spare, names))
    return max(found, key=lambda change: abs(change.sigmas), default=None)


def _of_poses(views: Views, state: CameraState) -> Iterator[tuple[str, Array]]:
    """Properties of the poses, (V,) each, that vary enough for a test."""
    distance = np.linalg.norm(state.t, axis=1) * views.scale
    if np.ptp(distance) > _NEARER * distance.max():
        yield "distance", 1.0 / distance
    if not views.nearly_flat.all():
        return
    normal = (state.R @ views.basis)[:, :, 2]
    normal *= -np.sign((normal * state.t).sum(axis=1, keepdims=True))
    for axis, name in enumerate("uv"):
        if np.ptp(normal[:, axis]) > _TURNED:
            yield f"tilt along {name}", normal[:, axis]


def directions(views: Views, state: CameraState, free: NDArray[np.bool_]) -> Iterator[tuple[str, Array]]:
    """Steps of A's entries and the coefficients for a unit change, by the name of what changes."""
    focal, size = np.zeros((2, len(free)))
    focal[:3] = size[:3] = state.entries[0, :3]
    size[3:5] = state.entries[0, 3:5] + views.pixel_centre / views.pixel_scale
    if free[0] and free[2]:
        yield "focal length", focal
    if free[[0, 2, 3, 4]].all():
        yield "image size", size


@frozen_dataclass(eq=False)
class _ScoreTest:
    """Scores of one parameter."""

    s: Array  # (P,)
    information: Array  # (P,) a.S_v a
    B: Array  # (P, f)
    S_inverse: Array  # (f, f)
    variance: float

    @classmethod
    def of(cls, scores: Quadratics, step: Array, variance: float) -> _ScoreTest:
        """Scores of the parameter whose unit change moves the free parameters by a step (f,)."""
        B = scores.S @ step
        return cls(scores.g @ step, B @ step, B, inverse_or_nan(scores.S.sum(axis=0)), variance)

    def cumulative(self, order: NDArray[np.intp]) -> tuple[Array, Array]:
        """Amounts and sigmas of all step patterns: 0 for the first k views of an order, 1 for the rest."""
        num = -np.cumsum(self.s[order])[:-1]  # the scores add up to 0
        B = np.cumsum(self.B[order], axis=0)[:-1]
        return self._tested(num, np.cumsum(self.information[order])[:-1], B)

    def pattern(self, c: Array) -> tuple[float, float]:
        """Amount and sigmas of one pattern."""
        amount, sigmas = self._tested(
            np.array([c @ self.s]), np.array([c**2 @ self.information]), (c @ self.B)[None]
        )
        return float(amount[0]), float(sigmas[0])

    def _tested(self, num: Array, diagonal: Array, B: Array) -> tuple[Array, Array]:
        known = diagonal - ((B @ self.S_inverse) * B).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            amount, sigmas = num / known, num / np.sqrt(known * self.variance)
        usable = (known > 1e-9 * diagonal) & np.isfinite(sigmas)
        return np.where(usable, amount, 0.0), np.where(usable, sigmas, 0.0)

    def scatter(self) -> tuple[float, float]:
        """Chi-squared of the differences between all views, and its degrees of freedom."""
        with np.errstate(divide="ignore", invalid="ignore"):
            chi = self.s**2 / self.information / self.variance
            shared = ((self.B @ self.S_inverse) * self.B).sum(axis=1) / self.information
        usable = np.isfinite(chi) & np.isfinite(shared)
        return float(chi[usable].sum()), max(float((1.0 - shared[usable]).sum()), 1.0)


def _patterns(
    test: _ScoreTest, lines: dict[str, Array]
) -> Iterator[tuple[str, NDArray[np.bool_], float, float]]:
    """Significant patterns: name, second group, amount and sigmas."""
    place = lines["line"]
    P = len(place)
    order = np.argsort(place, kind="stable")
    everywhere = np.ones(P, dtype=bool)
    chi, freedom = test.scatter()

    def beyond_scatter(sigmas: float) -> float:
        # If all views scatter by more than noise, as on real boards, patterns arise by chance.
        rest = (chi - sigmas**2) / max(freedom - 1, 1.0)
        usual = float(exceeded_by_chance(max(freedom - 1, 1.0), _SCATTER))
        return sigmas / float(np.sqrt(max(rest / usual, 1.0)))

    for name, values in lines.items():
        amount, sigmas = test.pattern((values - values.mean()) / max(float(np.ptp(values)), 1e-300))
        by_pose = name != "line"
        if by_pose and abs(amount) > _MOST_BY_POSE:
            continue
        if abs(sigmas := beyond_scatter(sigmas)) > (_BY_POSE if by_pose else _LINE):
            yield name, everywhere, amount, sigmas
    amounts, all_sigmas = test.cumulative(order)
    k = int(np.argmax(np.abs(all_sigmas[1:-1]))) + 1
    sigmas = beyond_scatter(float(all_sigmas[k]))
    if abs(sigmas) > _STEP:
        after = ~everywhere
        after[order[k + 1 :]] = True
        yield "step", after, float(amounts[k]), sigmas
    odd = ~everywhere
    odd[order[1::2]] = True
    amount, sigmas = test.pattern(odd.astype(float))
    if abs(sigmas := beyond_scatter(sigmas)) > _LINE:
        yield "groups", odd, amount, sigmas
    with np.errstate(divide="ignore", invalid="ignore"):
        own = np.nan_to_num(test.s / test.information, posinf=0.0, neginf=0.0)
    order = np.argsort(own, kind="stable")
    amounts, all_sigmas = test.cumulative(order)
    k = int(np.argmax(np.abs(all_sigmas)))
    two = float(all_sigmas[k] ** 2)
    by_chance = _MEAN * freedom + _TWO + _TWO_ROOT * np.sqrt(freedom)
    if two > by_chance and two > (_MEAN + _SHARE / np.sqrt(freedom)) * max(chi, two):
        larger = ~everywhere
        larger[order[k + 1 :]] = True
        # Sigmas of an equally significant pattern that was fixed beforehand.
        yield "groups", larger, float(amounts[k]), float(np.sqrt(two - by_chance + _LINE**2))
