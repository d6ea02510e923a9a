"""The verdict on a rig, good, usable or poor, with reasons and advice: its measures and its rules."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from neurocal_cli.calibration import Verdict
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.stereo.contradiction import Contradiction
from neurocal_cli.stereo.rig import Rig
from neurocal_cli.stereo.sound_pairs import MOVED, describe_faults, describe_move, pair_name
from neurocal_cli.verdict.findings import WORDS, Finding, Limit, verdict_of

# Repeated by tests/test_wrong_rigs.py, in which no wrong rig may be good, and by tests/test_rig_verdict.py,
# in which real and simulated good rigs are good. With real boards the relative poses scatter 2 to 3 times as
# much as noise explains.
_SCATTER = Limit(3.5, 10.0)
_GROWTH = Limit(1.6, 2.3)
_CHANGE = Limit(0.0, 10.0)  # standard deviations for each unknown of the explanation
_HELD_OUT = Limit(1.3, 2.0)  # over the rms error
_DEPTH = Limit(0.01, 0.05)  # std over the depth
_BASELINE = Limit(0.01, 0.05)  # std over the baseline
_LEFT_OUT = Limit(0.0, 0.34)  # share of the pairs

_MOMENT = (
    "trigger both cameras at the same moment, or hold the target still; check that the cameras are fixed"
)


@frozen_dataclass(eq=False)
class RigEvidence:
    """Measures of a rig's quality.

    Attributes
    ----------
    cameras : two of Verdict or None
        Verdict on each camera by its own points.
    names : tuple of (left name, right name)
        All pairs in order of their names.
    size : (P,) array
        Of each pair's target [world unit].
    moved : Contradiction or None
        Of all pairs, including those left out because the rig moved; None if it did not move.
    contradiction : Contradiction or None
        Of the pairs that determine the rig; None if a view does not determine its pose.
    displacement : float [world unit]
        Rms distance of the targets from their positions predicted by the rig, in the right camera.
    held_out_px : float [px]
        Five-fold cross-validation error over pairs; nan if no pair can be left out.
    depth : float [world unit]
        Median depth of the points.
    depth_share : float
        Standard deviation of triangulated depth over the depth, median over the points, for exact pixels.
    """

    cameras: tuple[Verdict | None, Verdict | None]
    names: tuple[tuple[str, str], ...]
    size: Array
    moved: Contradiction | None
    contradiction: Contradiction | None
    displacement: float
    held_out_px: float
    depth: float
    depth_share: float


def reach_rig_verdict(rig: Rig, evidence: RigEvidence) -> Verdict:
    """Apply the rules to the measures of a rig.

    Returns
    -------
    Verdict
    """
    nan = float("nan")
    found = evidence.contradiction
    measures = {
        "held_out_px": evidence.held_out_px,
        "alone_px": nan if found is None else rig.rmse_px / found.growth,
        "growth": nan if found is None else found.growth,
        "scatter": nan if found is None else found.scatter,
        "depth": evidence.depth,
        "depth_share": evidence.depth_share,
    }
    return verdict_of(_findings(rig, evidence), measures)


def _findings(rig: Rig, e: RigEvidence) -> Iterator[Finding]:
    if not rig.converged:
        yield 2, f"training did not converge: {rig.stop_reason}", "increase --starts"
    yield from _pairs(rig, e)
    yield from _precision(rig, e)
    for side, verdict in zip(("left", "right"), e.cameras, strict=True):
        if verdict is not None:
            # Reasons and advice come the worst first.
            for k, reason in enumerate(verdict.reasons):
                yield (1 if k else WORDS.index(verdict.word)), f"{side} camera: {reason}", ""
            for k, advice in enumerate(verdict.advice):
                yield (1 if k else WORDS.index(verdict.word)), "", advice


def _pairs(rig: Rig, e: RigEvidence) -> Iterator[Finding]:
    """Findings about pairs that do not agree on one rig."""
    if len(rig.pairs) == 1:
        yield 1, "the rig rests on one pair of views, and nothing checks it", "add pairs of views"
    if e.moved is not None:
        yield _rig_moved(rig, e, e.moved)
    odd = {
        pair: why for pair, why in rig.left_out.items() if not (e.moved is not None and why.startswith(MOVED))
    }
    if odd:
        yield (
            _LEFT_OUT.grade(len(odd) / len(e.names)),
            f"{describe_faults(odd, len(e.names))} and were left out",
            "look at the views of these pairs, and take them again",
        )
    found = e.contradiction
    if found is None:
        return
    if found.kind in ("left focal", "right focal", "late", "early"):
        yield _changed(e, found)
        return
    if found.kind == "moved":
        return
    poor = "the relative pose of the cameras differs from pair to pair"
    yield (
        max(_SCATTER.grade(found.rest), _GROWTH.grade(found.growth)),
        f"{poor}, by {found.rest:.2g} times what noise explains (rms {rig.rmse_px:.3g} px together, "
        f"{rig.rmse_px / found.growth:.3g} px each camera alone): the target moved by about "
        f"{e.displacement:.2g} {rig.unit} between the left and the right image, as they were not taken at "
        "the same moment, or the cameras are not fixed to each other",
        _MOMENT,
    )


def _rig_moved(rig: Rig, e: RigEvidence, found: Contradiction) -> Finding:
    used = set(rig.pairs)
    kept = [part for part in (e.names[: found.at], e.names[found.at :]) if used & set(part)]
    text, advice = describe_move(e.names, e.size, found.at, kept[0] if len(kept) == 1 else ())
    return _CHANGE.grade(found.gain), text, advice


def _changed(e: RigEvidence, found: Contradiction) -> Finding:
    """Finding about a focal length that changed, or images taken at different moments."""
    grade = _CHANGE.grade(found.gain)
    if found.kind in ("late", "early"):
        sense, way = {"late": ("later", "to the next"), "early": ("earlier", "back to the previous")}[
            found.kind
        ]
        return (
            grade,
            f"the two cameras were not triggered at the same moment: the right images were taken {sense}, as "
            f"they show the target {100 * found.amount:.2g} % of the way {way} pair's place",
            _MOMENT,
        )
    side = found.kind.partition(" ")[0]
    return (
        grade,
        f"the focal length of the {side} camera changed by {100 * found.amount:+.2g} % between "
        f"{pair_name(e.names[found.at - 1])} and {pair_name(e.names[found.at])}",
        "calibrate each part by itself, and lock zoom and focus",
    )


def _precision(rig: Rig, e: RigEvidence) -> Iterator[Finding]:
    more = "add pairs of views in which the target is near, tilted and fills both images"
    yield (
        _DEPTH.grade(e.depth_share),
        f"the std of triangulated depth is {100 * e.depth_share:.2g} % of the depth",
        more,
    )
    share = rig.std["baseline"] / rig.baseline if rig.baseline > 0 else np.inf
    yield _BASELINE.grade(share), f"the std of the baseline is {100 * share:.2g} % of its length", more
    if e.contradiction is not None and rig.rmse_px > 0:
        yield (
            _HELD_OUT.grade(e.held_out_px / rig.rmse_px),
            f"the cross-validation error is {e.held_out_px:.3g} px, but the error on all data "
            f"{rig.rmse_px:.3g} px",
            "add pairs of views",
        )
