"""Findings about errors common to the views: two cameras, a camera that changes, a bent board."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeVar

import numpy as np

from neurocal_cli.calibration.verdict.board_shape import BoardShape
from neurocal_cli.calibration.verdict.evidence import Evidence
from neurocal_cli.calibration.verdict.findings import Finding, Limit, name_some
from neurocal_cli.calibration.verdict.missing_coefficients import MissingCoefficients
from neurocal_cli.calibration.verdict.view_change import ViewChange
from neurocal_cli.calibration.verdict.view_groups import ViewGroups
from neurocal_cli.camera.geometry import Array

# Repeated by test_view_change.py and test_board_shape.py, with changes from 0.2 % and boards
# bent by 0.2 mm and more. A result is off by half of a change; careful calibrations state 0.05 %.
_CHANGED = Limit(0.001, 0.05)  # of the focal length
_APART = Limit(0.01, 0.05)  # of the focal length
# A small change of one parameter is preferred to two cameras if it explains nearly as much.
_LARGE = 0.03  # of the focal length: largest difference for which the score tests are valid
_NEARLY = 0.7  # share of the explained error that counts as nearly as much
_NEAR = 0.02  # of the focal length: equal up to this
# Real boards of good calibrations are bent as well; they bias the focal length by up to 0.4 % and 1.3 sigmas.
_OFF = Limit(0.005, 0.05)  # of the focal length
_SIGMAS = 2.0
# Rms error over that with all coefficients; Zhang's views, usable without their lens, leave 3.3.
_TOO_SIMPLE = Limit(1.2, 4.0)
# Largest error, in units of the noise floor, that may remain without a cause; otherwise it is not the cause
# or not the only one. Among the wrong inputs, true causes leave up to 1.04, and others 1.38 or more.
_LEFT = 1.25


Cause = TypeVar("Cause", BoardShape, ViewChange, ViewGroups)


def common_errors(evidence: Evidence, unit: str, wide: bool, estimated: bool) -> Iterator[Finding]:
    """Findings about a camera that is not the same in all views, or a board that is not flat.

    A wide lens may have no single centre of projection. `unit` is that of the world, and `estimated` tells
    whether the target was estimated.
    """
    missing, centre = evidence.missing, evidence.centre
    simple = missing is not None and _explains(missing.explained, evidence)
    if evidence.turned and not simple:  # distortion that is left looks like turned images
        yield _turned(evidence.turned)
        return
    change, board, groups = _explanation(evidence, estimated), evidence.board, evidence.groups
    if centre is not None and not any(
        other is not None and other.explained > _NEARLY * centre.explained
        for other in (change, board, groups, missing)
    ):
        yield (
            1,
            f"the image centre moves from view to view, by about {centre.size:.2g} px, as image "
            "stabilisation moves it",
            "switch image stabilisation off, or expect that predicted pixels are off by as much",
        )
        return
    if missing is not None and simple:
        # Residual distortion looks like a bent board, and like several cameras.
        least = missing.explained
        board, change, groups = _above(least, board), _above(least, change), _above(least, groups)
        if board is None and change is None and groups is None:
            yield _too_simple(missing)
    differ = groups if change is None else change
    if board is not None and not _explains(board.explained, evidence):
        board = None
    if board is not None and (differ is None or board.explained > _NEARLY * differ.explained):
        yield _bent(board, unit)
    if change is None and groups is not None:
        yield _of_several_cameras(groups)
    # A bent board makes views differ significantly as well; duplicated rows exaggerate the significance.
    if change is not None and not evidence.repeated and (board is None or change.explained > board.explained):
        yield _changed(change, wide)


def _turned(names: tuple[str, ...]) -> Finding:
    return (
        2,
        f"{name_some(names)}: turned by 180 degrees against the other images, so their centre is mirrored",
        "give all images as the camera has stored them, without turning them upright",
    )


def _too_simple(missing: MissingCoefficients) -> Finding:
    times, longer = 1.0 / np.sqrt(1.0 - missing.explained), missing.focal_length
    return (
        max(_TOO_SIMPLE.grade(times), _worse_by(longer, missing.sigmas)),
        f"the distortion model is too simple: {missing.model} lowers the error by "
        f"{100 * (1 - 1 / times):.2g} %, makes the focal length {100 * abs(longer):.2g} % "
        f"{'longer' if longer > 0 else 'shorter'}, and moves the image centre by {missing.centre:.2g} px",
        "give --distortion auto, or a model with more coefficients",
    )


def _above(share: float, cause: Cause | None) -> Cause | None:
    """The cause, if it explains at least this share of the squared error."""
    return None if cause is None or cause.explained < share else cause


def _explanation(evidence: Evidence, estimated: bool) -> ViewChange | None:
    """The change between views that explains the error; None if there is none, or if two cameras do.

    An estimated target has taken in a part of the change, and real boards leave other errors besides.
    """
    change, groups = evidence.change, evidence.groups
    if change is None:
        return None
    of_groups = estimated and change.pattern == "groups"
    if not of_groups and not _explains(change.explained, evidence):
        return None
    if groups is None:
        return change
    large = groups.apart > _LARGE and not groups.scale.size
    return None if large or change.explained < _NEARLY * groups.explained else change


def _explains(share: float, evidence: Evidence) -> bool:
    """Whether hardly more than noise remains if a share of the squared error is explained."""
    return not evidence.contradiction * np.sqrt(max(1.0 - share, 0.0)) > _LEFT


def _of_several_cameras(groups: ViewGroups) -> Finding:
    if groups.scale.size:
        return (
            _APART.grade(groups.apart),
            f"the focal length changes from view to view, by {100 * groups.apart:.2g} % in all: the zoom "
            "or the focus moved",
            "calibrate one zoom and one focus at a time; switch autofocus off",
        )
    first, second = groups.cameras[:, [0, 2, 3, 4]]
    asked = [f"alpha_u = {c[0]:.5g} px and the centre ({c[2]:.0f}, {c[3]:.0f})" for c in (first, second)]
    return (
        _APART.grade(groups.apart),
        f"the images come from two cameras, or {_alternative(first, second)}: {name_some(groups.names[0])} "
        f"fit {asked[0]}, the others {asked[1]}",
        "calibrate these views and the others separately",
    )


def _alternative(first: Array, second: Array) -> str:
    """The alternative to two cameras, from alpha_u, alpha_v, u0 and v0 of both."""
    ratio = first / second
    if np.abs(ratio - ratio[0]).max() < _NEAR and abs(ratio[0] - 1) > _NEAR:
        return "are of two sizes"
    if np.abs(first - second[[1, 0, 3, 2]]).max() < _NEAR * second[0]:
        return "u and v are exchanged in one part"
    if np.abs(ratio[:2] - 1).max() < _NEAR:
        return "one part is cropped or turned"
    return "from two zooms"


def _changed(change: ViewChange, wide: bool) -> Finding:
    size = abs(change.amount)
    percent, grows = f"{100 * size:.2g} %", "grows" if change.amount > 0 else "shrinks"
    what = "the focal length" if change.what == "focal length" else "the size of the image"
    turned = "the target changes its shape as it is turned, or the lens gives way"
    rays = ", or the rays of this wide lens do not meet in one point" if wide else ""
    how = {
        "line": "along the sequence of the views, so zoom or focus moves",
        "distance": f"from the farthest to the nearest view, so the focus moves{rays}",
        "tilt along u": f"from views of the target turned to the left to those to the right, so {turned}",
        "tilt along v": f"from views of the target turned upwards to downwards, so {turned}",
        "step": f"from view {change.views[0]} on, so zoom or focus has moved",
    }
    if change.pattern in how:
        reason = f"{what} {grows} by {percent} {how[change.pattern]}"
    else:
        reason = (
            f"{name_some(change.views)}: these views are scaled by {1 + change.amount:.4g} against the "
            "others, so the images are of two sizes, or of two settings of zoom or focus"
        )
    return (
        _CHANGED.grade(size),
        reason,
        "keep zoom and focus fixed, autofocus off, and all images at one size",
    )


def _bent(board: BoardShape, unit: str) -> Finding:
    off = abs(board.focal_length)
    return (
        _worse_by(off, board.sigmas),
        f"the residuals repeat on the board in all views: it seems {_shape(board, unit)}, which "
        f"makes the focal length {100 * off:.2g} % too {'short' if board.focal_length > 0 else 'long'}",
        "use a board that is flat, or measure its shape and give X,Y,Z as measured",
    )


def _worse_by(off: float, sigmas: float) -> int:
    """Grade of a relative error of the focal length, and of an error in standard deviations."""
    return max(int(sigmas > _SIGMAS), _OFF.grade(abs(off)))


def _shape(board: BoardShape, unit: str) -> str:
    if board.bend:
        return f"bent by {board.bend:.2g} {unit}"
    if abs(board.shear) > abs(board.stretch):
        return f"printed with sides that are {abs(board.shear):.2g} rad off a right angle"
    more = "stretched" if board.stretch > 0 else "shrunk"
    return f"{more} by {100 * abs(board.stretch):.2g} % along {board.side}"
