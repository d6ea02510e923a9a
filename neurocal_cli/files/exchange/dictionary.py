"""Dictionaries of matrices: OpenCV's FileStorage (YAML, XML, JSON), plain JSON, NumPy's ``.npz``.

One camera has ``camera_matrix`` and ``distortion_coefficients``; two have ``M1, D1, M2, D2, R, T`` as in
OpenCV's stereo sample. Poses of views are ``extrinsic_parameters``, with a row of rotation vector and
translation for each view as in OpenCV's calibration sample, or ``rvecs`` and ``tvecs`` as returned by
``calibrateCamera``. OpenCV's omnidirectional cameras have ``xi`` in addition to k1, k2, p1, p2. What people
save under other names of these is read by `loose_keys`.

Three cameras and more are as OpenCV's multi-view sample saves what ``calibrateMultiview`` returns: ``Ks``,
``distortions``, ``rvecs`` and ``Ts`` (``X_k = R X_0 + T``), ``is_fisheye``, ``image_sizes`` and ``cam_ids``
have an entry for each camera. Coefficients are filled up with 0 to the same number.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from neurocal_cli.calibration.rig.rectification import rectify
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError, NeurocalError
from neurocal_cli.files.camera_tree import matrix_data, storage_text
from neurocal_cli.files.exchange.camera_names import NAMES, PARAMETERS, is_matrix, plain_lists
from neurocal_cli.files.exchange.document import FROM_ZERO, UNKNOWN, Document, NoCameraError
from neurocal_cli.files.exchange.format_table import CameraSet, Format, PoseKeys, from_vector, to_vector
from neurocal_cli.files.exchange.loose_keys import LooseKeys
from neurocal_cli.files.exchange.neurocal import as_stereo
from neurocal_cli.files.exchange.tree_paths import arrays
from neurocal_cli.files.tree_fields import Field, plain
from neurocal_cli.files.yaml_text import nested

_K = "distortion_coefficients"
_OF_TWO = {"camera_matrix": "M", _K: "D"}  # the other keys of two cameras are those of one
_PLACED = PoseKeys("R T")  # from the first camera
_SIZE = ("image_width", "image_height")
_ROWS, _VECTORS, _VIEWS, _UNIT = "extrinsic_parameters", ("rvecs", "tvecs"), "view_names", "unit"

# Several cameras, of which each has its part of each array.
_FROM_FIRST = PoseKeys("rvecs:vector Ts", needed=True)
_ARRAYS = ("Ks", "distortions", "rvecs", "Ts", "is_fisheye", "image_sizes")  # the last two may be missing
_FEWEST = 5


def _multiview_tree(cameras: CameraSet) -> dict[str, Any]:
    """The dictionary of three cameras or more: texts and matrices."""
    if any(camera.distortion.model == "omnidir" for camera in cameras.cameras):
        raise InputError("OpenCV's file of several cameras has no omnidirectional ones; write another format")
    trees = [MULTIVIEW.tree(camera) for camera in cameras.cameras]
    width = max(_FEWEST, *(len(tree["distortions"]) for tree in trees))
    for tree, pose in zip(trees, cameras.mounted, strict=True):
        _FROM_FIRST.put(tree, pose)
        tree["is_fisheye"] = [float(tree["is_fisheye"])]
        tree["distortions"] = [np.pad(tree["distortions"], (0, width - len(tree["distortions"])))]
    stacked = {key: np.array([tree[key] for tree in trees], dtype=float) for key in _ARRAYS}
    if not stacked["image_sizes"].all():
        del stacked["image_sizes"]
    names = ",".join(tree["cam_ids"].replace(",", "_") for tree in trees)
    return {"cam_ids": names, **stacked, **({} if cameras.unit is None else {_UNIT: cameras.unit})}


def _multiview_parts(document: Document) -> dict[str, Field]:
    root = Field(plain_lists(document.root.value), document.source)
    n = len(_rows(root["Ks"], 9))
    of_each: dict[str, Any] = {}
    for key in _ARRAYS:
        if key in root:
            data = matrix_data(root[key], -1)
            if len(data) % n:
                root[key].fail(f"numbers for each of {n} cameras")
            of_each[key] = data.reshape(n, -1).tolist()
    of_each["is_fisheye"] = [str(int(row[0] > 0)) for row in of_each.get("is_fisheye", n * [[0.0]])]
    names = str(root.get("cam_ids", "").value).split(",")
    of_each["cam_ids"] = names if len(names) == n else [f"cam{k}" for k in range(n)]
    unit = {_UNIT: root.get(_UNIT).value}
    return {f"{k}": Field({key: of[k] for key, of in of_each.items()} | unit, root.source) for k in range(n)}


def _rows(field: Field, width: int) -> Array:
    """Rows of so many numbers, in any form."""
    data = matrix_data(field, -1)
    if not len(data) or len(data) % width:
        field.fail(f"{width} numbers for each")
    return data.reshape(-1, width)


def entries(cameras: CameraSet) -> dict[str, Any]:
    """Make the dictionary of cameras: texts, numbers, lists of names and matrices."""
    if len(cameras.cameras) > 2:
        return _multiview_tree(cameras)
    tree: dict[str, Any] = {}
    sides = ("",) if len(cameras.cameras) == 1 else ("1", "2")
    same = len({camera.image_size for camera in cameras.cameras}) == 1
    for side, camera in zip(sides, cameras.cameras, strict=True):
        own = arrays(OPENCV.tree(camera))
        for key in NAMES:
            if key not in own or (key in _SIZE and camera.image_size is None):
                continue
            end = "" if key in _SIZE and same else side
            tree[f"{_OF_TWO.get(key, key) if side else key}{end}"] = own[key]
    if cameras.has_lengths and cameras.unit is not None:
        tree[_UNIT] = cameras.unit
    if cameras.relative:
        (pose,) = cameras.relative
        tree |= dict(zip(_PLACED.paths, (pose.R, pose.t[:, None]), strict=True))
        rig = as_stereo(cameras)
        tree |= {"E": rig.E, "F": rig.F}
        rectified = rectify(rig)
        if rectified is not None:
            tree |= {key: getattr(rectified, key) for key in ("R1", "R2", "P1", "P2", "Q")}
    if cameras.poses:
        tree[_VIEWS] = list(cameras.poses)
        rows = [np.concatenate([to_vector(pose.R), pose.t]) for pose in cameras.poses.values()]
        tree[_ROWS] = np.array(rows)
    return tree


def _opencv_text(cameras: CameraSet, ending: str) -> Mapping[str, str | bytes]:
    """Write the dictionary for ``cv2.FileStorage``."""
    tree = entries(cameras)
    if "Ks" not in tree and any(camera.distortion.model == "fisheye" for camera in cameras.cameras):
        tree["fisheye_model"] = 1  # as in OpenCV's calibration sample
    return {"": storage_text(tree, ending)}


def json_text(tree: Mapping[str, Any]) -> str:
    """Write the dictionary as JSON, one entry per line; unknown numbers are null."""
    plain = {key: nested(value) if isinstance(value, np.ndarray) else value for key, value in tree.items()}
    lines = [f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in plain.items()]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def npz_bytes(tree: Mapping[str, Any]) -> bytes:
    """Write the dictionary for ``numpy.load``; the same dictionary gives the same bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, **tree)
    return buffer.getvalue()


_DEEPEST = 4  # mappings within each other
# Shares of the image's side by which the principal point is far from the middle, far outside, or in a corner.
_OFF, _OUTSIDE, _CORNER = 0.2, 1.0, 0.1
_SENSOR = 10.0  # px; a principal point nearer to the edge is in mm of a sensor
_SHORTEST, _SHORT = 3.0, 0.02  # focal lengths that no camera has, in px and as a share of the image's width
_SIDES = (
    ("1", "2"), ("left", "right"), ("l", "r"), ("0", "1"), ("cam0", "cam1"), ("cam1", "cam2"),
    ("camera0", "camera1"), ("camera1", "camera2"), ("cameraleft", "cameraright"),
)  # fmt: skip


def is_part(document: Document) -> bool:
    """Whether this is one of the two files of OpenCV's stereo sample: the cameras, or their pose."""
    if not document.tree:
        return False
    keys = LooseKeys(document.root)
    cameras = _sides(keys) is not None
    return cameras != (keys.find("T") is not None) and (cameras or not keys.has_camera())


def _parts(document: Document) -> dict[str, Field]:
    """One camera or two of a dictionary under our keys, or those in it that have poses of their own."""
    root = Field(plain_lists(document.root.value), document.source)
    if posed := _posed(root, document):
        return posed
    root = _within(root, document.notes)
    keys = LooseKeys(root, document.distortion, document.notes)
    sides = _sides(keys)
    if sides is None:
        one = next((side for pair in _SIDES[:3] for side in pair if keys.has_camera(side)), "")
        trees = [keys.tree("" if keys.has_camera() else one)]
    else:
        trees = [keys.tree(side) for side in sides]
    keys.refuse_unread()
    if sides is None:
        keys.note_others()
    else:
        lacking = [side for side, tree in zip(sides, trees, strict=True) if _K not in tree]
        if len(lacking) == 1:
            raise InputError(
                f"the camera {lacking[0]!r} has no distortion coefficients under a known name, the other has;"
                " name them alike, or add zeros"
            )
        R, t = map(keys.find, _PLACED.paths)
        if R is None or t is None:
            raise InputError("holds two cameras, but not their relative pose, R and T; give its file as well")
        trees[0] |= zip(_PLACED.paths, 2 * [[0.0, 0.0, 0.0]], strict=True)
        pose = matrix_data(R, 9).tolist(), matrix_data(t, 3).tolist()
        trees[1] |= zip(_PLACED.paths, pose, strict=True)
    if document.is_script:
        document.doubt(FROM_ZERO)
    trees[0] |= {key: root[key].value for key in (_ROWS, *_VECTORS, _VIEWS, _UNIT) if key in root}
    return {str(k): Field(tree, root.source) for k, tree in enumerate(trees)}


def with_sizes_noted(found: CameraSet, parts: Mapping[str, Field], document: Document) -> CameraSet:
    """The cameras; a warning tells a principal point far outside the image, or sides that are exchanged.

    Raises InputError for a focal length that is not in pixels.
    """
    for camera in found.cameras:
        f, (u0, v0), size = camera.intrinsics.alpha_u, camera.A[:2, 2], camera.image_size
        tiny = size is None and 0 < max(u0, v0) < _SENSOR and f < 10 * _SENSOR
        if tiny or f < (_SHORTEST if size is None else _SHORT * size[0]):
            raise InputError(
                f"the focal length {f:.6g} is not in pixels, but in mm or relative to the image; convert the "
                "camera matrix to pixels"
            )
        if size is None:
            continue
        w, h = size
        off, turned = (
            max(abs(u0 - (a - 1) / 2) / a, abs(v0 - (b - 1) / 2) / b) for a, b in (size, size[::-1])
        )
        doubt = None
        if off > _OFF and turned < 0.5 * off:
            doubt = (
                f"far from the middle of an image of {w} x {h}, and near that of {h} x {w}; if the file has "
                f"height and width, convert it with --image-size {h} {w}"
            )
        elif max(abs(u0) / w, abs(v0) / h) < _CORNER:
            doubt = (
                f"in the corner of an image of {w} x {h}; if it is counted from the middle, as in "
                "photogrammetry, add half of the size"
            )
        elif off > _OUTSIDE:
            doubt = f"far outside an image of {w} x {h}; check its size, and whether the images were cropped"
        if doubt is not None:
            document.doubt(f"the principal point ({u0:.6g}, {v0:.6g}) is {doubt}")
    return found


def _posed(root: Field, document: Document) -> dict[str, Field]:
    """Cameras in a list or a mapping, each with its rotation vector and translation as OpenCV has them.

    Those of the Panoptic data set have R and t, from the world as well.
    """
    value = root.value.get("cameras", root.value) if isinstance(root.value, dict) else root.value
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = [
        (str(name), Field(part, root.source, str(name)))
        for name, part in parts
        if isinstance(part, dict) and LooseKeys(Field(part, "")).has_camera()
    ]
    trees = {}
    for name, part in found if len(found) > 1 else ():
        keys = LooseKeys(part, document.distortion, document.notes)
        r, t = keys.find("rvec"), keys.find("tvec")
        if "distCoef" in part and "R" in part:
            r, t = part["R"], keys.find("t")
        if r is None or t is None:
            return {}
        stated = part.get("name").value
        pose = dict(zip(_PLACED.paths, (matrix_data(one, -1).tolist() for one in (r, t)), strict=True))
        tree = {**keys.tree(), **pose, "camera_name": stated if isinstance(stated, str) else name}
        keys.refuse_unread()
        trees[name] = Field(tree, root.source, name)
    if trees and isinstance(root.value, dict):
        next(iter(trees.values())).value[_UNIT] = root.get(_UNIT).value
    return trees


def _within(root: Field, notes: list[str]) -> Field:
    """The mapping that holds the camera: the root, or the only one in it that does, with the other keys."""
    others: dict[str, Any] = {}
    for _ in range(_DEEPEST):
        value = root.value
        if isinstance(value, dict):
            _refuse_stacked(value)
            root = Field({**others, **_sides_apart(value)}, root.source)
            keys = LooseKeys(root)
            if keys.has_camera() or _sides(keys) is not None or any(map(keys.has_camera, "12lr")):
                break
        elif not isinstance(value, list):
            raise NoCameraError(UNKNOWN)
        named = value.items() if isinstance(value, dict) else enumerate(value)
        parts = {str(name): part for name, part in named if _holds_camera(part)}
        if not parts:
            break
        name, part = next(iter(parts.items()))
        if len(parts) > 1:
            cameras = [_camera_of(part) for part in parts.values()]
            if None in cameras or any(camera != cameras[0] for camera in cameras):
                names = ", ".join(key[:20] for key in list(parts)[:9])
                raise InputError(
                    f"holds several cameras ({names}), and their relative poses in no form that is known; "
                    "save the keys of one camera as a file"
                )
            notes.append(f"{root.source}: holds the same camera {len(parts)} times")
        if isinstance(value, dict):
            # color_distortion belongs to color_intrinsics.
            own = next((word for word in PARAMETERS if plain(name).endswith(word) and len(word) > 2), "")
            stem = plain(name).removesuffix(own) if own else ""
            others |= {
                plain(str(key)).removeprefix(stem)
                if stem and plain(str(key)).startswith(stem)
                else key: entry
                for key, entry in value.items()
                if str(key) != name
            }
        root = Field(part, root.source)
    if not isinstance(root.value, dict):
        raise NoCameraError(UNKNOWN)
    return root


def _refuse_stacked(tree: Mapping[str, Any]) -> None:
    """Raise InputError for the camera matrices of several cameras in one array, without their poses."""
    for key, value in tree.items():
        if isinstance(value, list) and len(value) > 1 and all(map(is_matrix, value)):
            one = plain(str(key)).replace("matrices", "matrix")
            if {one, one.removesuffix("s")} & set(NAMES["camera_matrix"]):
                raise InputError(
                    f"holds the matrices of {len(value)} cameras, {key}, and their relative poses in no form "
                    "that is known; save one of them, and its coefficients, as a file: the keys K and D"
                )


def _sides_apart(tree: dict[str, Any]) -> dict[str, Any]:
    """The tree with the keys of the cameras of two sides, each in a mapping, beside its others."""
    for part in tree.values():  # R and T may be in a mapping as well
        if isinstance(part, dict) and {plain(str(key)) for key in part} & {"r", "t"} == {"r", "t"}:
            tree = {**part, **tree}
    names = {plain(str(key)): key for key, part in tree.items()}
    if names.keys().isdisjoint(NAMES["T"]):
        return tree
    names = {name: key for name, key in names.items() if _holds_camera(tree[key], 0)}
    for pair in _SIDES:
        if set(pair) <= set(names):
            apart = {f"{key}_{side}": value for side in pair for key, value in tree[names[side]].items()}
            return {**{key: value for key, value in tree.items() if key not in names.values()}, **apart}
    return tree


def _holds_camera(tree: Any, depth: int = _DEEPEST) -> bool:
    if isinstance(tree, list):
        return depth > 0 and any(_holds_camera(part, depth - 1) for part in tree if isinstance(part, dict))
    if not isinstance(tree, dict):
        return False
    keys = LooseKeys(Field(tree, ""))
    if keys.has_camera() or _sides(keys) is not None:
        return True
    return depth > 0 and any(_holds_camera(part, depth - 1) for part in tree.values())


def _camera_of(tree: Any) -> dict[str, Any] | None:
    """All that a camera says but its name; None if it cannot be read."""
    try:
        return {**LooseKeys(_within(Field(tree, ""), [])).tree(), "camera_name": ""}
    except NeurocalError:
        return None


def _sides(keys: LooseKeys) -> tuple[str, str] | None:
    """Suffixes of the keys of the two cameras; None if there are no two cameras."""
    found = [pair for pair in _SIDES if all(map(keys.has_camera, pair))]
    if len(found) > 1 and {"0", "1", "2"} <= {side for pair in found for side in pair}:
        keys.root.refuse(
            "holds three cameras or more in one dictionary; save the keys of one or two as a file"
        )
    return found[0] if found else None


def _views(root: Field) -> dict[str, Pose]:
    """Poses of the views of the first camera."""
    if _ROWS in root:
        rows = _rows(root[_ROWS], 6)
    elif all(key in root for key in _VECTORS):
        vectors = [_rows(root[key], 3) for key in _VECTORS]
        if len(vectors[0]) != len(vectors[1]):
            root[_VECTORS[1]].fail(f"as many translations as there are {_VECTORS[0]}")
        rows = np.hstack(vectors)
    else:
        return {}
    names = [f"{number}" for number in range(1, len(rows) + 1)]
    if _VIEWS in root:
        names = root[_VIEWS].names(len(rows))
    return {name: Pose(from_vector(row[:3]), row[3:]) for name, row in zip(names, rows, strict=True)}


def _unit(root: Field) -> str | None:
    return root.read(_UNIT, Field.text)


MULTIVIEW = Format(
    "OpenCV",
    "Ks:matrix",
    """
    0: plumb_bob distortions
    0: rational distortions
    0: thin_prism distortions
    0: tilted distortions
    1: fisheye distortions
    """,
    model="is_fisheye",
    size="image_sizes",
    name="cam_ids",
    told=" ".join(_ARRAYS[:4]),
    files="cv2.FileStorage of several cameras, as its multi-view sample writes it",
    parts=_multiview_parts,
    pose=_FROM_FIRST,
    unit=_unit,
    finish=with_sizes_noted,
    likely=False,
    rig="`rvecs, Ts`: `X_k = R X_0 + T`",
)
OPENCV = Format(
    "OpenCV",
    "camera_matrix:matrix",
    """
    plumb_bob: plumb_bob distortion_coefficients
    rational_polynomial, rational: rational distortion_coefficients
    thin_prism: thin_prism distortion_coefficients
    tilted: tilted distortion_coefficients
    equidistant, fisheye: fisheye distortion_coefficients
    omnidir: omnidir xi distortion_coefficients/0-3
    none: none
    k1k2: k1k2 distortion_coefficients
    k1k2p1p2: k1k2p1p2 distortion_coefficients
    double_sphere: double_sphere distortion_coefficients
    eucm: eucm distortion_coefficients
    rich: rich distortion_coefficients
    k1: k1 distortion_coefficients/0
    """,
    model="distortion_model",
    size="image_width,image_height",
    name="camera_name",
    told=lambda document: document.tree or isinstance(document.root.value, list),
    files="cv2.FileStorage: YAML, XML, JSON, and what people save with its names",
    parts=_parts,
    pose=_PLACED,
    unit=_unit,
    views=_views,
    finish=with_sizes_noted,
    texts=_opencv_text,
    written=("none", "plumb_bob", "rational", "thin_prism", "tilted", "fisheye", "omnidir"),
    likely=False,
    poses=True,
    rig="`R, T`: `X_2 = R X_1 + T`; of three cameras and more `rvecs, Ts`: `X_k = R X_0 + T`",
)
JSON = replace(
    OPENCV,
    program="JSON",
    told="",
    texts=lambda cameras, _: {"": json_text(entries(cameras))},
    files="dictionary of the same names",
    has_skew=True,
)
NPZ = replace(
    JSON,
    program="NumPy",
    texts=lambda cameras, _: {"": npz_bytes(entries(cameras))},
    files=".npz; .npy of the matrix, and of the coefficients",
)
