"""ROS's camera_info files: one camera per file; the rectified projections of a pair give its relative pose.

``projection_matrix`` of the right camera contains ``-fx b`` [px m], and the rectification matrices make both
cameras parallel. Therefore R = R2^T R1 and t = R2^T (P2[0, 3], P2[1, 3], 0) / f.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from neurocal_cli.calibration.rig.rectification import must_rectify
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.camera_tree import format_camera_info, matrix_data
from neurocal_cli.files.exchange import dictionary
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.format_table import CameraSet
from neurocal_cli.files.exchange.loose_keys import LooseKeys
from neurocal_cli.files.exchange.neurocal import as_stereo
from neurocal_cli.files.tree_fields import Field, is_number

_TEXT = re.compile(r"^\s*camera matrix\s*$", re.MULTILINE)  # of ost.txt
_RECTIFIED = {"rectification_matrix": 9, "projection_matrix": 12}
_REGION = ("x_offset", "y_offset", "width", "height")
_LABEL = re.compile(r"\s*\[?([A-Za-z][\w /.-]*)\]?\s*").fullmatch


def _matches(document: Document) -> object:
    """Whether this is a camera_info file, a message as ``rostopic echo`` prints it, or ost.txt."""
    tree = document.tree
    info = "camera_matrix" in tree and {"rectification_matrix", "projection_matrix"} & set(tree)
    message = {"K", "P"} <= set(tree) or {"k", "p", "distortion_model"} <= set(tree)
    return info or (message and "distortion_model" in tree) or _TEXT.search(document.text[:5000])


def _parts(document: Document) -> dict[str, Field]:
    root = _ost(document) if _TEXT.search(document.text[:5000]) else document.root
    keys = LooseKeys(root, document.distortion, document.notes)
    tree = keys.tree()
    for key, count in _RECTIFIED.items():
        if (found := keys.find(key)) is not None:
            tree[key] = matrix_data(found, count).tolist()
    keys.refuse_unread()
    if root.get("binning_x", 0).integer() > 1 or root.get("binning_y", 0).integer() > 1:
        document.note("has binning; the camera is that of the images before it")
    corner_and_size = [root.get("roi", {}).get(key, 0).value for key in _REGION]
    if any(corner_and_size):
        document.note(
            "has a region of interest; the camera is that of the whole images, and neurocal resize "
            f"CAMERA.yaml --crop {' '.join(map(str, corner_and_size))} makes that of the region"
        )
    return {"camera": Field(tree, document.source)}


def _with_rectification(found: CameraSet, parts: Mapping[str, Field], document: Document) -> CameraSet:
    """The camera with its pose in a rectified pair, if the file has one."""
    found = dictionary.with_sizes_noted(replace(found, unit="m"), parts, document)
    R, P = (np.array(parts["camera"].get(key).value, dtype=float) for key in _RECTIFIED)
    if P.size != 12 or P[0] <= 0 or P[5] <= 0:  # ROS's drivers write zeros where nothing is known
        return found
    rotation = R.reshape(3, 3) if R.size == 9 and R.any() else np.eye(3)
    return replace(found, rectified=(rotation, P.reshape(3, 4)))


def _ost(document: Document) -> Field:
    """The tree of ost.txt or ost.ini, in which a line names the numbers below it."""
    tree: dict[str, Any] = {}
    name = ""
    for line in document.text.splitlines():
        line = line.partition("#")[0].strip()
        if _LABEL(line) and not is_number(line):
            if line.startswith("["):
                if line != "[image]":
                    tree["camera_name"] = line.strip("[]")
            else:
                name = line
        elif line:
            tree.setdefault(name, []).extend(line.split())
    root = Field(tree, document.source)
    tree |= {side: root[side].array(1)[0] for side in ("width", "height") if side in root}
    rational = len(root["distortion"].array(-1)) > 5
    tree["distortion_model"] = "rational_polynomial" if rational else "plumb_bob"
    return root


def joined(left: CameraSet, right: CameraSet) -> CameraSet:
    """Join the cameras of two files to a rig; an InputError if they are no rectified pair."""
    shifts = []
    for part in (left, right):
        if part.rectified is not None:
            P = part.rectified[1]
            shifts.append(np.array([P[0, 3] / P[0, 0], P[1, 3] / P[1, 1], 0.0]))
    if len(shifts) < 2 or not shifts[1].any() or shifts[0].any():
        raise InputError(
            "the two ROS files are no pair: the right camera's projection_matrix must hold the baseline, and "
            "the left one's none; give the left camera first, or the file of the rig"
        )
    assert left.rectified is not None
    assert right.rectified is not None
    first, second = left.rectified[0], right.rectified[0]
    pose = Pose(second.T @ first, second.T @ shifts[1])
    return replace(left, cameras=(left.cameras[0], right.cameras[0]), relative=(pose,), rectified=None)


def _text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    if len(cameras.cameras) == 1:
        return {"": format_camera_info(cameras.cameras[0], cameras.rectified)}
    rectified = must_rectify(as_stereo(replace(cameras, origin=None)), None, "give --image-size")
    pairs = (rectified.R1, rectified.P1), (rectified.R2, rectified.P2)
    return {
        f"{side}.yaml": format_camera_info(camera, pair)
        for side, camera, pair in zip(("left", "right"), cameras.cameras, pairs, strict=True)
    }


FORMAT = replace(
    dictionary.OPENCV,
    program="ROS",
    told=_matches,
    files="camera_info YAML, a message printed by rostopic echo, ost.txt, ost.ini",
    parts=_parts,
    pose=None,
    views=None,
    finish=_with_rectification,
    texts=_text,
    written=("none", "plumb_bob", "rational", "fisheye"),
    poses=False,
    at_most=2,
    unit="m",
    needs_size=True,
    rectified=True,
    rig="two files; `projection_matrix` of the right one holds the baseline",
)
