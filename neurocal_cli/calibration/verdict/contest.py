"""The contest of the rival causes: which ones explain the residuals, and what is said of them.

The most probable rival wins, unless two simpler ones together are more probable. The winner is included in
the camera, and the others compete for what is left, until none is more than chance.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.adjust import NEARBY, adjust
from neurocal_cli.adjustment.board.prior import STRETCH
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.normal_equations import NOTHING
from neurocal_cli.adjustment.reprojection import farthest_angle
from neurocal_cli.adjustment.residual_correlation import correlation, effective_number
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.verdict.effects import another_lens, common, field, no_pupil
from neurocal_cli.calibration.verdict.findings import (
    CONTRADICTION,
    DETERMINE,
    DISPLACED,
    ERROR,
    EXPLAINED,
    LEVEL,
    Finding,
    Limit,
    image_diagonal,
    log_odds,
    or_else,
)
from neurocal_cli.calibration.verdict.linearised import Effect, Linearised, linearised
from neurocal_cli.calibration.verdict.rival import (
    Estimate,
    Known,
    Rival,
    Told,
    estimates,
    given_changes,
    including,
)
from neurocal_cli.calibration.verdict.rivals import (
    ANOTHER_LENS,
    EFFECTS,
    NEIGHBOURS,
    OF_POSES,
    RICHER_LENSES,
    RIVALS,
    SHAPES,
)
from neurocal_cli.calibration.verdict.words import NEAR
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_MOST = 3  # causes at once, and rivals that are tried together with another one
_MINOR = 0.03  # share of a cause's evidence below which a further one is what its linearisation leaves
_FAR = 0.25  # the same after a cause that was fitted, or that each view has in its own way
_MUCH = 0.3  # share of the evidence beside the target's shape, or of the error of a lens, that counts
_FAR_MORE = 2.0  # times the log evidence of an estimated target, or of given poses that are wrong


@frozen_dataclass(eq=False)
class Contest:
    """The causes that explain the residuals of a camera, the first one found first."""

    lin: Linearised
    causes: tuple[Estimate, ...]  # that were included in turn, each with what it changes beside those before
    close: tuple[tuple[Estimate, ...], ...]  # rivals that are hardly less probable, of each cause
    explained: float  # share of the squared error that all of them explain
    evidence: float  # log odds over nothing if the residuals of neighbours were independent
    n: float  # effective number of equations beyond the unknowns
    std_of_poses: Array | None = None  # (V, 6) reported ones of omega and tau, normalised
    counted_by_std: float = 1.0  # share of the residuals that the reported std count as independent

    @property
    def of_all_views(self) -> bool:
        """Whether a cause that all views share, but not the target's shape, explains most of the error."""
        first = next((one for one in self.causes[:1] if one.explained >= EXPLAINED), None)
        return first is not None and first.pattern == "all" and not first.rival.of_board

    @property
    def left(self) -> Array:
        """(N, 2) residuals that the causes leave, normalised, in the order of the points."""
        steps = np.zeros((self.lin.views.n_views, self.lin.width))
        for one in self.causes:
            steps += _steps(self.lin, one)
        return self.lin.residuals(steps)

    def instead_of_target(self, counted: float = 1.0) -> float:
        """Log odds of causes other than the target's shape, known or not; 0 if there are none.

        A cause that cannot be told from the target's shape says nothing against it. The level by which the
        others have to beat that shape is taken off; a given value, which the shape takes in, comes first if
        it is hardly less probable. That shape has `counted` of each equation.
        """
        first = self.causes[0] if self.causes else None
        if first is None:
            return 0.0
        own = first.rival
        if not (own.of_board or own.of_given) and any(x.rival.of_board for x in self.close[0]):
            return 0.0
        if first.rival.effect in OF_POSES:  # the target takes in what is wrong with given poses
            return _FAR_MORE * counted * self.evidence
        # A lens whose rays do not meet in one point says nothing against a shape that comes before it.
        beside = (no_pupil,) if first.rival.of_board else ()
        known = [one for one in self.causes if not (one.rival.unknown or one.rival.effect in beside)]
        others = [one.evidence for one in known if not one.rival.of_board]
        told = sum(one.evidence for one in self.causes)
        if max(others, default=0.0) > _MUCH * told or first.rival.unknown or first.pattern == "one":
            return counted * self.evidence + (LEVEL if first.rival.of_given else -LEVEL)
        # A shape that is far more probable than the found one is not open: no print is stretched by percents.
        return counted * told / _FAR_MORE if first.pattern == "all" else 0.0


def contest(
    m: Minimum,
    image_size: tuple[int, int] | None,
    shaped: bool = False,
    rivals: tuple[Rival, ...] = RIVALS,
) -> Contest | None:
    """Let the rivals compete at the minimum of a camera; None if its views do not determine it.

    `shaped` tells whether the target's common shape was estimated with the camera.
    """
    if m.views.n_equations <= int(m.free.sum()) + 6 * m.views.n_views:
        return None
    known = tuple(effect for effect in EFFECTS if not (m.free_poses and effect in OF_POSES))
    worth = 1.0 if m.repeated is None else m.repeated.worth

    def at_minimum(*more: Effect) -> Linearised:
        lin = linearised(m, (*known, *more), image_size)
        return _with_shape(lin) if shaped else lin

    try:
        held = _held(at_minimum(), worth, rivals)
        if not held.causes:
            return held
        lin = at_minimum(field, another_lens)
        between = [one.pattern != "all" and not one.rival.of_board for one in held.causes]
        told = sum(one.evidence for one in held.causes[: [*between, True].index(True) + 1])
        lenses = estimates(lin, held.n, (ANOTHER_LENS,))
        if any((_fitted(lin, one, held.n) or one).evidence > told + LEVEL for one in lenses):
            held = _held(lin, worth, (ANOTHER_LENS,))  # what it leaves of other causes would be guessed
        if all(one.pattern == "all" for one in held.causes):
            return held
        smooth, beside = estimates(lin, held.n, (NEIGHBOURS,)), lin
        for one in held.causes:
            beside = including(beside, one)
        # What the causes leave, such as what is not linear in them, may be noise that neighbours share, too.
        found = [*held.causes, *estimates(beside, held.n, (NEIGHBOURS,), 0.0)[:1]]
        if not smooth or sum(max(one.evidence, 0.0) for one in found) > smooth[0].evidence + LEVEL:
            return held
        of_all = tuple(rival for rival in rivals if rival.patterns is common)
        return _held(including(lin, smooth[0]), worth, of_all)
    except np.linalg.LinAlgError:
        return None


def _with_shape(lin: Linearised) -> Linearised:
    """The same camera, with the common shape of the target as further unknowns.

    A shape that was estimated first has taken in some of what other causes do.
    """
    new = np.concatenate([rival.steps_at(lin).argmax(axis=0) for rival in SHAPES])
    R = lin.R.copy()
    R[0, new, new] += lin.cost / lin.spare / (2 * STRETCH) ** 2
    return replace(lin, R=R, free=np.concatenate([lin.free, new]), spare=max(lin.spare - len(new), 1.0))


def _held(lin: Linearised, worth: float, rivals: tuple[Rival, ...]) -> Contest:
    n = lin.spare * worth
    ranking = estimates(lin, n, rivals, LEVEL)
    fitted: set[str] = set()
    if ranking and ranking[0].evidence > LEVEL:
        # Alike even with the best rival, not because of it.
        alike = correlation(lin.views, lin.residuals(_steps(lin, ranking[0])))
        of_two = _errors_of_two(lin, ranking[0], n, rivals)
        if of_two is not None:
            alike = min(alike, correlation(lin.views, of_two))
        n = effective_number(n, alike)
        fits = [(one, _fitted(lin, one, n)) for one in estimates(lin, n, rivals)]
        fitted = {one.rival.cause for one, fit in fits if fit is not None}
        ranking = sorted((fit or one for one, fit in fits), key=lambda one: -one.evidence)
    share = n / lin.spare
    at, evidence, left, least = lin, 0.0, 1.0, 0.0
    causes: list[Estimate] = []
    before = np.zeros(len(lin.free))  # change of the camera by the causes so far
    close: list[tuple[Estimate, ...]] = []
    while ranking and ranking[0].evidence > max(LEVEL, least) and len(causes) < _MOST:
        ranking = _likeliest_first(ranking)
        chosen = _best(at, ranking, share, rivals)
        far = not chosen[0].weights.size or chosen[0].rival.cause in fitted
        least = max(least, (_FAR if far else _MINOR) * chosen[0].evidence)
        for one in chosen:
            causes.append(replace(one, camera=one.camera[: len(before)] - before))
            alone = one is ranking[0]
            close.append(tuple(x for x in ranking[1:] if alone and x.evidence > one.evidence - LEVEL))
            evidence, left = evidence + one.evidence, left * (1.0 - one.explained)
            at = including(at, one)
            before = Known.at(at, at.spare).right[: len(before)]
        ranking = estimates(at, at.spare * share, _others(causes, rivals))
    # As an estimated target counts it: all residuals as independent.
    evidence -= 0.5 * lin.spare * (worth - share) * float(np.log(max(left, NOTHING)))
    return Contest(lin, tuple(causes), tuple(close), 1.0 - left, evidence, n)


def _errors_of_two(lin: Linearised, first: Estimate, n: float, rivals: tuple[Rival, ...]) -> Array | None:
    """(N, 2) residuals with a second cause beside the first; at least one of them is shared by views."""
    at = including(lin, first)
    seconds = estimates(at, n, _others([first], rivals), LEVEL)
    second = next((one for one in seconds if first.weights.size or one.weights.size), None)
    if second is None or second.evidence < LEVEL:
        return None
    if not first.weights.size:
        first, own = second, first.rival
        at = including(lin, first)
        second = next(iter(estimates(at, n, (own,))), second)
    f = len(lin.free)
    of_first = first.weights[:, None] * (first.rival.steps_at(lin) @ second.camera[f:])
    return lin.residuals(_steps(lin, replace(second, camera=second.camera[:f])) + of_first)


def _likeliest_first(ranking: list[Estimate]) -> list[Estimate]:
    """Of those that are hardly less probable than the first, a given value comes first, the unknown last."""
    n = sum(one.evidence >= ranking[0].evidence - LEVEL for one in ranking)
    return sorted(ranking[:n], key=lambda one: (not one.rival.of_given, one.rival.unknown)) + ranking[n:]


def _others(causes: Iterable[Estimate], rivals: tuple[Rival, ...]) -> tuple[Rival, ...]:
    known = {one.rival.cause for one in causes}
    return tuple(one for one in rivals if one.cause not in known)


def _best(
    at: Linearised, ranking: list[Estimate], share: float, rivals: tuple[Rival, ...]
) -> tuple[Estimate, ...]:
    """The best rival, or two that are more probable together than it is by itself or with another one."""
    best: tuple[Estimate, ...] = (ranking[0],)
    highest = ranking[0].evidence + LEVEL
    if ranking[0].pattern == "all":
        return best  # few unknowns do not look like two causes by chance
    others = [one for one in ranking[1:] if one.evidence >= LEVEL and not one.rival.unknown]
    for one in [one for one in (*best, *others) if one.weights.size][: _MOST + 1]:
        both = including(at, one)
        single = one.pattern == "one"
        apart = _others([one, ranking[0]] if single else [one], rivals)
        second = estimates(both, both.spare * share, apart, highest - one.evidence)
        # One of them is common to all views, as changes of groups look like each other; or it is in one view
        # alone, and what each view has in its own way is no longer the same as without it.
        beside = ("all", "") if single else ("all",)
        second = [x for x in second if not x.rival.unknown and (one.pattern == "all" or x.pattern in beside)]
        if second and one.evidence + second[0].evidence > highest:
            best, highest = (one, second[0]), one.evidence + second[0].evidence
    return best[:1] if best[0] is ranking[0] else best


def _fitted(lin: Linearised, one: Estimate, n: float) -> Estimate | None:
    """Fit a cause that looks different beyond the linear range; None for others.

    Two cameras that are far apart are fitted, and lenses and given values that explain much. For a lens of
    another kind, `rational` is. `n` is the effective number of equations beyond the unknowns.
    """
    views, state, free = lin.views, lin.state, lin.free
    of_given = one.rival.of_given and views.n_views >= DETERMINE and not state.square
    if one.rival.cause == "two cameras" and np.abs(one.amounts[:4]).max() > NEAR:
        member = one.weights > 0.5
        groups = [np.flatnonzero(member), np.flatnonzero(~member)]
    elif (of_given or one.rival in RICHER_LENSES) and one.explained > _MUCH:
        free = np.append(lin.free, np.flatnonzero(one.rival.steps_at(lin).any(axis=1)))
        groups = [np.arange(views.n_views)]
    elif one.rival is ANOTHER_LENS and lin.alphas_free and state.model != "rich":
        from neurocal_cli.camera.nearest_camera import similar_states

        similar = similar_states(state, "rational", farthest_angle(views, state))
        if not similar:
            return None
        state = similar[0]
        free = np.concatenate([free[free < 5], 5 + np.arange(len(state.k))])
        groups = [np.arange(views.n_views)]
    else:
        return None
    moving = np.isin(np.arange(5 + len(state.k)), free)
    fits = [
        adjust(views.subset(some).batches, state.of_views(some), moving, lin.free_poses, NEARBY)
        for some in groups
    ]
    cost, left = sum(float(fit.cost.sum()) for fit in fits), n * one.noise
    # The other group has a whole camera of its own, of which the rival may have the centre alone.
    further = max((len(fits) - 1) * len(free) - one.amounts.size, 0)
    if not (0 < cost < left and (more := log_odds(left, cost, n, further)) > 0):
        return one
    camera, amounts = one.camera, one.amounts
    if len(fits) == 1 and one.rival is not ANOTHER_LENS:
        step, camera = fits[0].state.entries[0] - lin.state.entries[0], camera.copy()
        of_entries = lin.free < 5
        camera[of_entries] = step[lin.free[of_entries]]
        if one.rival.of_given and one.rival.steps_at(lin)[:5].any():
            steps = one.rival.steps_at(lin)[:5]
            amounts = step @ steps / (steps**2).sum(axis=0)
    return replace(
        one, evidence=one.evidence + more, explained=1.0 - cost / lin.cost, amounts=amounts, camera=camera,
        noise=cost / n,
    )  # fmt: skip


def _steps(lin: Linearised, found: Estimate) -> Array:
    """(V, c) steps of all columns with a rival."""
    V = lin.views.n_views
    amounts = found.amounts if not found.weights.size else found.weights[:, None] * found.amounts
    steps = amounts @ found.rival.steps_at(lin).T
    own = np.zeros((V, lin.width))
    own[:, lin.free] = found.camera
    return own + steps


BIASED = Limit(2.0, 5.0)
"""Limits of a bias of the focal lengths and the centre, or of what is given or left out, over their std."""
_UNCLEAR = 5.0  # times the level: a weaker further cause is not told beside one that is too small to be told


def explains(contest: Contest, contradiction: float, error: float) -> bool:
    """Whether the views hardly contradict each other with the causes, or half of what is more is explained.

    `error` is the rms error over the image's diagonal; if it is large, a large one must not remain.
    """
    left = float(np.sqrt(max(1.0 - contest.explained, 0.0)))
    if error * left > ERROR.good < error:
        return False
    excess = 1.0 - contradiction**-2
    return not (contradiction * left > CONTRADICTION.good and contest.explained < EXPLAINED * excess)


def findings(contest: Contest, calibration: Calibration, given_told: bool) -> Iterator[Finding]:
    """What the causes do to the camera.

    `given_told` tells whether a wrong given value is named already, by the values that the points have.
    """
    estimated, small = calibration.target is not None, True
    for place, (found, close) in enumerate(zip(contest.causes, contest.close, strict=True)):
        if found.rival.of_given and (given_told or _is_uncertain(found, contest, calibration)):
            continue
        if found.rival.of_board and estimated:
            continue  # the standard deviations include it
        if place and any(x.rival.unknown for x in close):
            continue  # a further cause has to beat that of none as well
        names = dict.fromkeys(other.rival.cause for other in close if _is_another(found, other))
        grade, reason = _graded(contest, found, calibration)
        named = found.rival.steps is not None and not calibration.lens_choice
        if found.pattern == "all" and (found.rival.of_board or named):
            # The standard deviations do not include the board, nor a lens that was not selected.
            grade = max(grade, int(not found.rival.of_given))
        if place and small and found.evidence < _UNCLEAR * LEVEL:
            continue  # it may be what a cause leaves that is too small to be told
        small = small and not grade
        advice = (found.rival.of_selected if calibration.lens_choice else "") or found.rival.advice
        yield grade, reason + or_else(names), advice


def given_camera(contest: Contest, calibration: Calibration) -> list[Finding]:
    """What the points say against the camera that was given for them."""
    given = tuple(found for found in contest.causes if found.rival.of_given)
    return list(findings(replace(contest, causes=given, close=((),) * len(given)), calibration, False))


def _is_uncertain(found: Estimate, contest: Contest, calibration: Calibration) -> bool:
    """Whether the change of a given focal length or centre is within its standard deviations."""
    std, lin = calibration.std_of_given, contest.lin
    if found.rival.steps_at(lin)[5:].any():
        return False
    alpha = float(lin.state.entries[0, 0]) * lin.views.pixel_scale
    names = ("alpha_u", "theta", "alpha_v", "u0", "v0")
    return all(
        abs(by) * alpha <= BIASED.poor * std.get(names[k], 0.0) for k, by in given_changes(lin, found).items()
    )


def closest(contest: Contest | None, calibration: Calibration) -> str:
    """The words of the most probable cause; "" without any."""
    if contest is None or not contest.causes:
        return ""
    return _graded(contest, contest.causes[0], calibration)[1]


def _graded(contest: Contest, found: Estimate, calibration: Calibration) -> tuple[int, str]:
    diagonal = image_diagonal(calibration.points)
    told = Told(contest.lin, found, calibration.unit, calibration.std, diagonal, contest.std_of_poses)
    reason, size = found.rival.say(told)
    grade = found.rival.limit.grade(size)
    # Poses that rest on what is given have no other measure of their bias.
    moved = found.pattern == "all" and (found.rival.of_given or not contest.lin.free.size)
    by_poses = BIASED.grade(told.moved_poses) if moved else 0
    if by_poses:
        grade = max(grade, 1 + int(by_poses > 1 and found.explained > EXPLAINED))
    # What differs from view to view is in the std.
    if not found.weights.size:
        return grade, reason
    biased = (
        abs(by) / calibration.std[name] for name, by in told.biases.items() if calibration.std[name] > 0
    )
    # Residuals that are alike because of a cause are no noise that neighbours share.
    by_bias = BIASED.grade(max(biased, default=0.0) / contest.counted_by_std**0.5)
    return max(grade, min(by_bias, 1) if found.rival.of_distance else by_bias), reason


def _is_another(found: Estimate, other: Estimate) -> bool:
    """Whether it is a cause of another kind; changes of zoom, size and camera between views are one kind."""
    between_views = (found.rival, other.rival)
    alike = all(one.patterns is not None and one.limit is not DISPLACED for one in between_views)
    return other.rival.cause != found.rival.cause and not other.rival.unknown and not alike
