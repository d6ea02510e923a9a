"""What is said of the causes that won: a reason with amounts, and the size by which it is graded."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from neurocal_cli.adjustment.adjust import NEARBY, adjust
from neurocal_cli.adjustment.free_networks import seen_from_behind
from neurocal_cli.calibration.verdict.effects import BENDS
from neurocal_cli.calibration.verdict.findings import (
    DETERMINE,
    STRETCHED_PRINT,
    WRONG_PRINT,
    Said,
    in_sequence,
    name_some,
    percent,
    two_digits,
)
from neurocal_cli.calibration.verdict.rival import Say, Told, given_changes
from neurocal_cli.camera.geometry import Array

NEAR = 0.02
"""Of the focal length: two cameras are equal up to this."""
_TURNED = 0.3  # of the distance of two centres: how far their mean may be from the middle of the image
_SOME = 0.15  # share of the largest change of a given value from which on others are told, too


def plain(text: str) -> Say:
    """Words with the displaced pixels, the first view that has it, and what it makes of the focal length."""
    return lambda told: (
        text.format(px=f"{told.displaced:.2g}", view=next(iter(told.members), ""), makes=_makes(told)),
        told.displaced / told.diagonal,
    )


def changing(what: str) -> Say:
    """A focal length or an image size that changes between the views."""

    def say(told: Told) -> Said:
        amount, pattern = float(told.found.amounts[0]), told.found.pattern
        by = f"{what} {'grows' if amount > 0 else 'shrinks'} by {percent(abs(amount))}"
        turned = "the target changes its shape as it is turned, or the lens gives way"
        how = {
            "line": "along the sequence of the views, so zoom or focus moves",
            "distance": "from the farthest to the nearest view, so the focus moves",
            "tilt along u": f"from views of the target turned to the left to those to the right, so {turned}",
            "tilt along v": f"from views of the target turned upwards to downwards, so {turned}",
            "step": f"from view {told.members[0]} on, so zoom or focus has moved" if told.members else "",
        }
        if pattern in how:
            return f"{by} {how[pattern]}", abs(amount)
        return (
            f"{name_some(told.members)}: these views are scaled by {1 + amount:.4g} against the others, so "
            "the images are of two sizes, or of two settings of zoom or focus",
            abs(amount),
        )

    return say


def zooming(told: Told) -> Said:
    """A focal length of each view's own."""
    size = float(np.ptp(told.found.amounts))
    by = f"by {percent(size)} in all"
    return f"the focal length changes from view to view, {by}: the zoom or the focus moved", size


def stabilised(told: Told) -> Said:
    """A centre of each view's own; not of interest if it moves less than it is known."""
    size = float(np.sqrt((told.found.amounts**2).mean()))
    known = max(told.std["u0"], told.std["v0"])
    return (
        f"the image centre moves from view to view, by about {size * told.alpha:.2g} px, as image "
        "stabilisation moves it",
        size if size * told.alpha > known else 0.0,
    )


def two_cameras(told: Told) -> Said:
    """The cameras of both groups, adjusted, and what may make the difference."""
    lin, px = told.lin, told.lin.views.pixel_scale
    member = told.found.weights > 0.5
    if 2 * np.count_nonzero(member) > len(member):
        member = ~member
    free = np.zeros(5 + len(lin.state.k), dtype=bool)
    free[lin.free[lin.free < len(free)]] = True
    cameras = []
    for which in (np.flatnonzero(member), np.flatnonzero(~member)):
        step = told.found.rival.steps_at(lin) @ told.found.amounts * told.found.weights[which[0]]
        step[lin.free] += told.found.camera[: len(lin.free)]  # without the unknowns of an earlier cause
        entries = lin.state.entries[0] + step[:5]
        if len(which) >= DETERMINE:
            batches, state = lin.views.subset(which).batches, lin.state.of_views(which)
            entries = adjust(batches, state, free, lin.free_poses, NEARBY).state.entries[0]
        cameras.append(entries[[0, 2, 3, 4]] * px + np.append([0.0, 0.0], lin.views.pixel_centre))
    order = in_sequence(lin.views.names)
    names, others = ([lin.views.names[k] for k in order if member[k] == some] for some in (True, False))
    behind = set(seen_from_behind(lin.views, lin.state))
    exchanged = behind.issuperset(names) or behind.issuperset(others)
    middle = lin.middle * px + lin.views.pixel_centre
    alternative = _alternative(cameras[0], cameras[1], middle, exchanged)
    apart = float(np.abs(cameras[0] - cameras[1]).max() / cameras[1][0])
    if alternative == "turned by 180 degrees":
        return (
            f"{name_some(names)}: {alternative} against the other images, so their centre is mirrored",
            max(apart, 1.0),
        )
    asked = [f"alpha_u = {c[0]:.5g} px and the centre ({c[2]:.0f}, {c[3]:.0f})" for c in cameras]
    return (
        f"the images come from two cameras, or {alternative}: {name_some(names)} fit {asked[0]}, the others "
        f"{asked[1]}",
        apart,
    )


def _alternative(first: Array, second: Array, middle: Array, exchanged: bool) -> str:
    """The alternative to two cameras, from alpha_u, alpha_v, u0 and v0 of both [px].

    `middle` is that of the image, and `exchanged` tells whether one group shows the target mirrored.
    """
    ratio, near = first / second, NEAR * second[0]
    if exchanged:
        return "u and v are exchanged in one part"
    if np.abs(ratio / ratio[0] - 1).max() < min(0.3 * abs(ratio[0] - 1), 2 * NEAR):
        return "are of two sizes"
    zoomed, apart = np.abs(first[:2] - second[:2]).max(), np.abs(first[2:] - second[2:]).max()
    if zoomed < 2 * near and np.abs(0.5 * (first[2:] + second[2:]) - middle).max() < 0.5 * _TURNED * apart:
        return "turned by 180 degrees"
    if abs(ratio[0] - ratio[1]) > 0.5 * abs(ratio[:2] - 1).max() > NEAR:
        return "their target or their images are stretched in one part"
    if zoomed >= near:
        return "from two zooms"
    if np.abs(first[2:] - second[:1:-1]).max() < 2 * near:
        return "some are turned by 90 degrees"
    return "one part is cropped or turned"


def two_targets(told: Told) -> Said:
    """A target that is stretched in a group of views."""
    by, lean = told.found.amounts.tolist()
    shape = f"longer by {percent(by)}" if abs(by) > abs(lean) else f"leaning by {lean:.2g} rad"
    return f"{name_some(told.members)}: a target of another shape than in the others, {shape}", max(
        abs(by), abs(lean)
    )


def odd_view(told: Told) -> Said:
    """One view with another camera."""
    moved = told.found.amounts * told.alpha
    return (
        f"{told.members[0]}: it fits another camera or crop: its focal length is {moved[0]:+.2g} px and its "
        f"centre ({moved[-2]:+.2g}, {moved[-1]:+.2g}) px from that of the others",
        told.displaced / told.diagonal,
    )


def wrong_poses(how: str) -> Say:
    """Given poses that are wrong, by how much (rms)."""

    def say(told: Told) -> Said:
        turn, shift = np.sqrt((told.found.amounts.reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0)).tolist()
        which = f"{told.members[0]}: " if told.found.pattern == "one" else ""
        return (
            f"{which}{how}, by {shift * told.lin.views.scale.mean():.2g} {told.unit} and "
            f"{np.degrees(turn):.2g} degrees",
            told.displaced / told.diagonal,
        )

    return say


def bent(told: Told) -> Said:
    """A common bend."""
    terms = [(float(height), i, j) for height, (i, j) in zip(told.found.amounts, BENDS, strict=True)]
    height = told.lin.board.bend(lambda x, y: np.sum([h * x**i * y**j for h, i, j in terms], axis=0))
    return _on_board(told, f"bent by {height:.2g} {told.unit}")


def stretched(told: Told) -> Said:
    """A print that is stretched, or whose sides lean."""
    by, lean = told.found.amounts.tolist()
    longer, other = ("XYZ"[int(np.argmax(np.abs(axis)))] for axis in told.lin.board.axes.T[:2])
    if by < 0:
        longer, other = other, longer
    shape = f"longer by {percent(abs(by))} along {longer}, compared with {other}"
    if abs(lean) > abs(by):
        shape = f"printed with sides that are {abs(lean):.2g} rad off a right angle"
    reason, size = _on_board(told, shape)
    wrong = max(abs(by), abs(lean)) > STRETCHED_PRINT.good
    return reason + (f"; {WRONG_PRINT}" if wrong else ""), size


def deformed(told: Told) -> Said:
    """A target in space that is stretched, or whose planes lean."""
    from neurocal_cli.adjustment.open_choices import SOLID_STRETCHES

    strain = np.einsum("k,kij->ij", told.found.amounts, SOLID_STRETCHES)
    sides, (a, b) = np.diagonal(strain), divmod(int(np.abs(np.triu(strain, 1)).argmax()), 3)
    longer, other = int(sides.argmax()), int(sides.argmin())
    shape = f"longer by {percent(np.ptp(sides))} along {'XYZ'[longer]}, compared with {'XYZ'[other]}"
    if 2 * abs(strain[a, b]) > np.ptp(sides):
        shape = f"with {'XYZ'[a]} and {'XYZ'[b]} off a right angle by {2 * abs(strain[a, b]):.2g} rad"
    return _on_board(told, f"a target of another shape, {shape}", "target")


def _on_board(told: Told, shape: str, where: str = "board") -> Said:
    return (
        f"the residuals repeat on the {where} in all views: it seems {shape}, which {_makes(told)}",
        abs(told.longer),
    )


def _makes(told: Told) -> str:
    return f"makes the focal length {percent(abs(told.longer))} too {'short' if told.longer > 0 else 'long'}"


def rolling(told: Told) -> Said:
    """Rows that were read while the camera moved."""
    rows = float(np.ptp(told.lin.views.pixels[:, 1])) * told.lin.views.pixel_scale
    px = float(np.sqrt((told.found.amounts**2).mean())) * rows
    return (
        f"camera or target moved while the rows of the images were read, by about {px:.2g} px from the first "
        "points to the last: a rolling shutter",
        px / told.diagonal,
    )


def cut(first: str, second: str) -> Say:
    """Halves of the images that are displaced against each other."""

    def say(told: Told) -> Said:
        du, dv = told.found.amounts * told.lin.views.pixel_scale
        return (
            f"the {second} half of the images is displaced by ({du:.2g}, {dv:.2g}) px against the {first} "
            "one: a cut through the image, as in stitched images",
            float(np.hypot(du, dv)) / told.diagonal,
        )

    return say


def too_simple(model: str) -> Say:
    """A distortion model without coefficients that the lens needs."""

    def say(told: Told) -> Said:
        left, longer, biases = np.sqrt(1.0 - told.found.explained), told.longer, told.biases
        moved = float(np.hypot(biases.get("u0", 0.0), biases.get("v0", 0.0)))
        return (
            f"the distortion model is too simple: {model} lowers the error by {percent(1 - left)}, "
            f"makes the focal length {percent(abs(longer))} {'longer' if longer > 0 else 'shorter'}, and "
            f"moves the image centre by {moved:.2g} px",
            told.displaced / told.diagonal,
        )

    return say


def wrongly_given(told: Told) -> Said:
    """Given focal lengths and centre, what the points have, and what that does to the poses."""
    lin, changes = told.lin, given_changes(told.lin, told.found)
    largest = max(map(abs, changes.values()))
    if lin.state.square and len(changes) == 1:
        (amount,) = changes.values()
        return f"the pixels are not square: alpha_v - alpha_u is {100 * amount:+.2g} % of alpha_u", largest
    if lin.views.n_views < DETERMINE and len(changes) > 2:
        text = "the given camera does not fit these points: another focal length or centre does"
        return text + _poses(told), largest
    names: Mapping[int, str] = {0: "alpha_u", 2: "alpha_v", 3: "u0", 4: "v0"}
    before = lin.state.entries[0] * lin.views.pixel_scale + [0, 0, 0, *lin.views.pixel_centre]
    by = [
        f"{names[k]} = {before[k]:.5g} is given, but the points give {before[k] + a * told.alpha:.5g} px"
        for k, a in changes.items()
        if abs(a) > _SOME * largest
    ]
    return ", ".join(by) + _poses(told), largest


def wrongly_given_lens(told: Told) -> Said:
    """Given distortion, or none."""
    px = told.displaced
    text = f"the given distortion does not fit these points, by {px:.2g} px rms: another one does"
    lacking = told.lin.columns["lens"]
    if lacking.size and lacking[0] == 5:
        text = f"the camera is given without distortion, but the points show one, by {px:.2g} px rms"
    return text + _poses(told), px / told.diagonal


def _poses(told: Told) -> str:
    moved = told.moved_poses
    if not moved > 1:
        return ""
    return f"; the poses are then {two_digits(moved)} standard deviations from the reported ones"
