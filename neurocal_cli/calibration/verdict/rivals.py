"""The list of rival causes.

To add a cause, add a `Rival`: what it does to the pixels (`effects`) or to the camera, the pattern in which
views share it (`patterns`), and its words. Ten lines are usual.
"""

from __future__ import annotations

from dataclasses import replace

from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.calibration.verdict import effects, words
from neurocal_cli.calibration.verdict.findings import DISPLACED, ERROR, SHARE, Limit
from neurocal_cli.calibration.verdict.rival import Rival, causes_among
from neurocal_cli.camera.distortion import POLYNOMIAL_MODELS

CHANGED = Limit(0.002, 0.05)
"""Limits of a change of the focal length or the centre, over the focal length; a result has half of it."""
_POSES = Limit(0.0, DISPLACED.poor)  # nothing takes in what is wrong with given ones
SAME = "check that what is given is of the same camera at the same zoom, focus and image size"
"""Advice where it is wrong."""
_TO_CORNERS = "add views with points nearer to the image's corners, by which a richer lens can be selected"
_BLOCKS = (8, 16)  # sizes of the blocks of video codecs [px]
_FIXED = "keep zoom and focus fixed, autofocus off, and all images at one size"
_APART_ADVICE = "calibrate these views and the others separately, and give all images as they were stored"
_FLAT = "use a board that is flat, or measure its shape and give X,Y,Z as measured"
_STIFF = "fix the target to something stiff"
_STILL = "keep camera and target still, or use a camera with a global shutter"
_WHOLE = "give the images as the sensor has them, or calibrate each half as a camera of its own"
RICHER_LENSES = tuple(
    Rival(
        "a lens that is too simple",
        "residuals that grow towards the corners, or one side, in the same way in all views",
        "give --distortion auto, or a model with more coefficients",
        words.too_simple(model),
        DISPLACED,
        effects.common,
        steps=effects.lens(model),
        of_selected=_TO_CORNERS,
    )
    for model in (*POLYNOMIAL_MODELS[1:], "rational", "omnidir")
)
"""A lens that lacks coefficients."""

RIVALS: tuple[Rival, ...] = (
    *RICHER_LENSES,
    *(
        Rival(
            "a wrong given parameter",
            "the given focal length or centre, moved, takes the residuals away",
            SAME,
            words.wrongly_given,
            CHANGED,
            effects.common,
            steps=steps,
            of_given=True,
        )
        for steps in (effects.given, effects.given_scale)  # one unknown is told from less than four are
    ),
    Rival(
        "a wrong given distortion",
        "other coefficients than the given ones take the residuals away",
        SAME,
        words.wrongly_given_lens,
        DISPLACED,
        effects.common,
        steps=effects.given_lens,
        of_given=True,
    ),
    Rival(
        "wrong given poses",
        "in each view, another pose than the given one takes the residuals away",
        "check that each pose was read while its image was taken, or let them be estimated, with --type 1",
        words.wrong_poses("the given poses are wrong, each in its own way"),
        _POSES,
        effect=effects.pose,
    ),
    Rival(
        "a wrong given pose",
        "the same in one view alone",
        "correct this pose, or leave the view out",
        words.wrong_poses("the given pose is wrong"),
        _POSES,
        effects.one_view,
        effect=effects.pose,
    ),
    *(
        Rival(
            f"given poses with a wrong place of the {what}",
            f"one motion of the {what} in all views takes the residuals away",
            f"calibrate {'hand and eye' if what == 'camera' else 'where the target is'} again",
            words.wrong_poses(f"all given poses are wrong by one motion of the {what}, {how}"),
            _POSES,
            effects.common,
            effect=effect,
        )
        for what, how, effect in (
            ("camera", "as with a wrong hand-eye calibration", effects.moved_camera),
            ("target", "as if it were elsewhere on its table or tool", effects.moved_target),
        )
    ),
    Rival(
        "a changing focal length",
        "scaled residuals around the centre, along the sequence, by distance or tilt, or in a group of views",
        _FIXED,
        words.changing("the focal length"),
        CHANGED,
        effects.changing,
        steps=effects.focal_length,
    ),
    Rival(
        "a changing image size",
        "scaled residuals around the image's corner, in the same patterns",
        _FIXED,
        words.changing("the size of the image"),
        CHANGED,
        effects.changing,
        steps=effects.image_size,
    ),
    Rival(
        "a zoom that moves",
        "each view asks for a focal length of its own",
        "calibrate one zoom and one focus at a time; switch autofocus off",
        words.zooming,
        SHARE,
        steps=effects.focal_length,
    ),
    Rival(
        "image stabilisation",
        "each view asks for a centre of its own",
        "switch image stabilisation off, or expect that predicted pixels are off by as much",
        words.stabilised,
        CHANGED,
        steps=effects.centre,
    ),
    *(
        Rival(
            "two cameras",
            "two groups of views, each with one camera: other images, crops, images turned or exchanged",
            _APART_ADVICE,
            words.two_cameras,
            SHARE,
            effects.grouped,
            steps=steps,
        )
        for steps in (effects.camera_and_lens, effects.centre)
    ),
    Rival(
        "two targets",
        "two groups of views, each with a target of another length along one side",
        "give each view the points of the target that it shows",
        words.two_targets,
        CHANGED,
        effects.grouped,
        effect=effects.stretch,
    ),
    Rival(
        "one odd view",
        "one view asks for another camera than the others",
        "leave this view out, or give it as the camera has stored it",
        words.odd_view,
        DISPLACED,
        effects.one_view,
        steps=effects.camera,
    ),
    Rival(
        "a bent target",
        "residuals that repeat on the target in all views, along its normal",
        _FLAT,
        words.bent,
        CHANGED,
        effects.common,
        effect=effects.bends,
        of_board=True,
    ),
    Rival(
        "a stretched target",
        "residuals that repeat on the target in all views, within its plane",
        _FLAT,
        words.stretched,
        CHANGED,
        effects.common,
        effect=effects.stretch,
        of_board=True,
    ),
    Rival(
        "a deformed target",
        "the same of a target in space: one axis is longer than another, or two are not perpendicular",
        "measure the target, and give X,Y,Z as measured",
        words.deformed,
        CHANGED,
        effects.common,
        effect=effects.deformed,
        of_board=True,
    ),
    Rival(
        "a target that bends",
        "smooth residuals along the target's normal, in each view others",
        _STIFF,
        words.plain("the target bends from view to view, by {px} px rms"),
        DISPLACED,
        effect=effects.bends,
        of_board=True,
    ),
    Rival(
        "a target that is bent in one view",
        "the same in one view alone",
        f"leave this view out, or {_STIFF}",
        words.plain("{view}: the target is bent in this view"),
        DISPLACED,
        effects.one_view,
        effect=effects.bends,
        of_board=True,
    ),
    Rival(
        "a plate of glass",
        "points that move away from the foot of the camera's perpendicular on the target",
        "take the glass away",
        words.plain("the points are displaced by {px} px rms, as if seen through a plate of glass"),
        DISPLACED,
        effects.common,
        effect=effects.glass,
    ),
    Rival(
        "rays that do not meet in one point",
        "residuals around the centre that are others for near targets than for far ones",
        "photograph the target at the distances at which you measure",
        words.plain(
            "near and far targets do not fit one camera, by {px} px rms, which {makes}: the rays do not meet "
            "in one point, as in a wide lens, or behind a flat window under water"
        ),
        DISPLACED,
        effects.common,
        effect=effects.no_pupil,
        of_distance=True,
    ),
    Rival(
        RICHER_LENSES[0].cause,
        "residuals that are round in the image, and not in the angles of the rays",
        "give --distortion rich, with 20 views or more",
        words.plain("the lens squeezes the image: its distortion differs along u and v, by {px} px rms"),
        DISPLACED,
        effects.common,
        effect=effects.squeezed,
    ),
    *(
        Rival(
            "a rolling shutter",
            "displacements that grow with the row, in each view others",
            _STILL,
            words.rolling,
            ERROR,  # photographs taken by hand move by up to 0.001
            effect=effect,
        )
        for effect in (effects.turning, effects.moving)
    ),
    *(
        Rival(
            f"a cut along {'vu'[axis]}",
            "two halves of the images that are displaced against each other",
            _WHOLE,
            words.cut(*halves),
            DISPLACED,
            effects.common,
            effect=effects.cut(axis),
        )
        for axis, halves in enumerate((("left", "right"), ("upper", "lower")))
    ),
    *(
        Rival(
            "a video codec",
            f"residuals that repeat in blocks of {side} px",
            "take single images, or a video of higher quality",
            words.plain(f"residuals of {{px}} px rms repeat in blocks of {side} px, as of a video codec"),
            DISPLACED,
            effects.common,
            effect=effects.blocks(side),
        )
        for side in _BLOCKS
    ),
    Rival(
        "no single camera",
        "each view asks for a camera of its own, for no known reason",
        "check that all views are of one camera, and that the target has the true shape",
        words.plain(
            "each view asks for a camera of its own, by {px} px rms: no single camera fits, as with a target "
            "of another shape"
        ),
        DISPLACED,
        steps=effects.camera,
        unknown=True,
    ),
)
"""All rivals; those with the same name are alternatives of one cause."""
NEIGHBOURS = replace(RIVALS[-1], cause="noise that neighbours share", steps=None, effect=effects.field)
"""Causes that differ between views are not told if this is as probable as all causes together."""
ANOTHER_LENS = replace(
    RICHER_LENSES[0],
    say=words.plain(
        "the distortion model is too simple: a smooth field that all views share displaces the points by "
        "{px} px rms"
    ),
    advice="give --distortion auto or rich",
    steps=None,
    effect=effects.another_lens,
)
"""They are not told if this one is more probable, nor is a view left out."""
ODD_VIEW = next(rival for rival in RIVALS if rival.patterns is effects.one_view and rival.steps)
"""One view with another camera."""
ODD_POSE = next(
    rival for rival in RIVALS if rival.patterns is effects.one_view and rival.effect is effects.pose
)
"""One view with another pose than the given one."""
SHAPES = tuple(rival for rival in RIVALS if rival.of_board and rival.patterns is effects.common)
"""Those by which the target has another shape in all views."""


def explained_by_shape(m: Minimum) -> float:
    """Largest share of the squared error that another shape of the target explains."""
    return max((one.explained for one in causes_among(SHAPES, m)), default=0.0)


EFFECTS = tuple(dict.fromkeys(rival.effect for rival in RIVALS if rival.effect is not None))
"""All effects of the rivals."""
OF_POSES = (effects.pose, effects.moved_camera, effects.moved_target)
"""Those that estimated poses take in."""
