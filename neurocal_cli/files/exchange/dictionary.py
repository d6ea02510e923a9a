"""Dictionaries of matrices: OpenCV's FileStorage (YAML, XML, JSON), plain JSON, NumPy's ``.npz``.

One camera has ``camera_matrix`` and ``distortion_coefficients``; two have ``M1, D1, M2, D2, R, T`` as in
OpenCV's stereo sample. Poses of views are ``extrinsic_parameters``, with a row of rotation vector and
translation for each view as in OpenCV's calibration sample, or ``rvecs`` and ``tvecs`` as returned by
``calibrateCamera``. OpenCV's omnidirectional cameras have ``xi`` in addition to k1, k2, p1, p2.

Three cameras and more are as OpenCV's multi-view sample saves what ``calibrateMultiview`` returns: ``Ks``,
``distortions``, ``rvecs`` and ``Ts`` (``X_k = R X_0 + T``), ``is_fisheye``, ``image_sizes`` and ``cam_ids``
have an entry for each camera. Coefficients are filled up with 0 to the same number.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from neurocal_cli.calibration.rig.rectification import rectify
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.opencv_names import to_ros
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError, NeurocalError
from neurocal_cli.files.camera_tree import matrix_data, storage_text
from neurocal_cli.files.exchange.camera_keys import CameraKeys, Lens
from neurocal_cli.files.exchange.camera_names import PARAMETERS, plain, plain_lists
from neurocal_cli.files.exchange.camera_set import CameraSet, Format, from_vector, mounted, to_vector
from neurocal_cli.files.exchange.document import FROM_ZERO, UNKNOWN, Document, NoCameraError
from neurocal_cli.files.exchange.format_table import PoseKeys
from neurocal_cli.files.exchange.loose_keys import LooseKeys
from neurocal_cli.files.exchange.neurocal import as_stereo
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import nested

# One of several cameras, which has its part of each array.
_MULTIVIEW = CameraKeys(
    "OpenCV",
    ("Ks:matrix",),
    (
        *(Lens(("0",), ours, ("distortions",)) for ours in ("plumb_bob", "rational", "thin_prism", "tilted")),
        Lens(("1",), "fisheye", ("distortions",)),
    ),
    model="is_fisheye",
    size=("image_sizes",),
    name="cam_ids",
)
_FROM_FIRST = PoseKeys(("rvecs:vector", "Ts"), needed=True)
_ARRAYS = ("Ks", "distortions", "rvecs", "Ts", "is_fisheye", "image_sizes")  # the last two may be missing
_FEWEST = 5


def multiview_entries(cameras: CameraSet) -> dict[str, Any]:
    """The dictionary of the cameras: texts and matrices."""
    if any(camera.distortion.model == "omnidir" for camera in cameras.cameras):
        raise InputError("OpenCV's file of several cameras has no omnidirectional ones; write another format")
    trees = [_MULTIVIEW.tree(camera) for camera in cameras.cameras]
    width = max(_FEWEST, *(len(tree["distortions"]) for tree in trees))
    for tree, pose in zip(trees, cameras.mounted, strict=True):
        _FROM_FIRST.put(tree, pose)
        tree["is_fisheye"] = [float(tree["is_fisheye"])]
        tree["distortions"] = [np.pad(tree["distortions"], (0, width - len(tree["distortions"])))]
    stacked = {key: np.array([tree[key] for tree in trees], dtype=float) for key in _ARRAYS}
    if not stacked["image_sizes"].all():
        del stacked["image_sizes"]
    names = ",".join(tree["cam_ids"].replace(",", "_") for tree in trees)
    return {"cam_ids": names, **stacked, **({} if cameras.unit is None else {"unit": cameras.unit})}


def is_multiview(root: Field) -> bool:
    """Whether a dictionary is one of several cameras."""
    return isinstance(root.value, dict) and set(_ARRAYS[:4]) <= set(root.value)


def multiview_cameras(root: Field) -> CameraSet:
    """Read the cameras; see `multiview_entries`."""
    n = len(_flat(root["Ks"], 9)) // 9
    if not n:
        root["Ks"].fail("a matrix of 3 x 3 for each camera")
    arrays = {key: _of_each(root[key], n).tolist() for key in _ARRAYS if key in root}
    arrays["is_fisheye"] = [str(int(row[0] > 0)) for row in arrays.get("is_fisheye", n * [[0.0]])]
    names = str(root.get("cam_ids", "").value).split(",")
    arrays["cam_ids"] = names if len(names) == n else [f"cam{k}" for k in range(n)]
    parts = [Field({key: of[k] for key, of in arrays.items()}, root.source, root.path) for k in range(n)]
    cameras, poses = map(_MULTIVIEW.camera, parts), map(_FROM_FIRST.read, parts)
    return mounted(list(cameras), list(poses), "OpenCV", root.read("unit", Field.text))


def _of_each(field: Field, n: int) -> Array:
    """(n, m) numbers of each of n cameras."""
    data = _flat(field)
    if not len(data) or len(data) % n:
        field.fail(f"numbers for each of {n} cameras")
    return data.reshape(n, -1)


def _flat(field: Field, width: int = 1) -> Array:
    """Numbers in nested lists of any depth, in a matrix, or in a list of matrices; a multiple of `width`."""
    value = field.value
    if isinstance(value, dict):
        values = matrix_data(field, -1)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        values = np.concatenate([matrix_data(entry, width) for entry in field.items()])
    else:
        try:
            values = np.array(value, dtype=float).ravel()
        except (TypeError, ValueError):
            field.fail("numbers")
    if not np.isfinite(values).all() or len(values) % width:
        field.fail(f"{width} finite numbers for each" if width > 1 else "finite numbers")
    return values


def entries(cameras: CameraSet) -> dict[str, Any]:
    """Make the dictionary of cameras: texts, numbers, lists of names and matrices."""
    if len(cameras.cameras) > 2:
        return multiview_entries(cameras)
    first = cameras.cameras[0]
    tree: dict[str, Any] = {}
    sides = ("",) if len(cameras.cameras) == 1 else ("1", "2")
    same = all(camera.image_size == first.image_size for camera in cameras.cameras)
    for side, camera in zip(sides, cameras.cameras, strict=True):
        end = "" if same else side
        tree[f"camera_name{side}"] = camera.name
        if camera.image_size is not None and (f"image_width{end}" not in tree):
            tree[f"image_width{end}"], tree[f"image_height{end}"] = camera.image_size
        model, k = to_ros(camera.distortion.model, camera.distortion.coefficients)
        tree[f"distortion_model{side}"] = model
        if model == "omnidir":
            tree[f"xi{side}"], k = float(k[0]), k[1:]
        tree[f"M{side}" if side else "camera_matrix"] = camera.A
        tree[f"D{side}" if side else "distortion_coefficients"] = k[None]
    if cameras.has_lengths and cameras.unit is not None:
        tree["unit"] = cameras.unit
    if cameras.relative:
        (pose,) = cameras.relative
        tree |= {"R": pose.R, "T": pose.t[:, None]}
        rig = as_stereo(cameras)
        tree |= {"E": rig.E, "F": rig.F}
        rectified = rectify(rig)
        if rectified is not None:
            tree |= {key: getattr(rectified, key) for key in ("R1", "R2", "P1", "P2", "Q")}
    if cameras.poses:
        tree["view_names"] = list(cameras.poses)
        rows = [np.concatenate([to_vector(pose.R), pose.t]) for pose in cameras.poses.values()]
        tree["extrinsic_parameters"] = np.array(rows)
    return tree


def opencv_text(cameras: CameraSet, ending: str) -> Mapping[str, str | bytes]:
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
    """Write the dictionary for ``numpy.load``, without the time stamps of ``numpy.savez``."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for key, value in tree.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asanyarray(value), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{key}.npy"), member.getvalue())
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
_ROTATIONS = ("r", "rstereo", "stereor", "rotation", "rotationmatrix", "rot")
_TRANSLATIONS = ("t", "tstereo", "stereot", "translation", "translationvector", "trans", "trns")


def is_part(document: Document) -> bool:
    """Whether this is one of the two files of OpenCV's stereo sample: the cameras, or their pose."""
    if not document.tree:
        return False
    keys = LooseKeys(document.root)
    cameras = _sides(keys) is not None
    return cameras != (keys.find(_TRANSLATIONS) is not None) and (cameras or not keys.has_camera())


def read(document: Document) -> CameraSet:
    """Read one camera or two."""
    found = from_tree(document.root, document)
    if document.is_script:
        document.warnings.append(f"{document.source}: {FROM_ZERO}")
    return found


def from_tree(root: Field, document: Document) -> CameraSet:
    """Read one camera or two from a dictionary, or those in it that have poses of their own."""
    root = Field(plain_lists(root.value), root.source, root.path)
    if is_multiview(root):
        several = multiview_cameras(root)
        for camera in several.cameras:
            note_size(camera, document)
        return several
    if (rig := _posed(root, document)) is not None:
        return rig
    root = _within(root, document.notes)
    unit = root.read("unit", Field.text)
    keys = LooseKeys(root, document.distortion, document.notes)
    sides = _sides(keys)
    if sides is None:
        one = next((side for pair in _SIDES[:3] for side in pair if keys.has_camera(side)), "")
        camera = keys.camera("" if keys.has_camera() else one)
        keys.refuse_unread()
        keys.note_others()
        note_size(camera, document)
        return CameraSet((camera,), (), _poses(root), unit)
    cameras = tuple(keys.camera(side) for side in sides)
    keys.refuse_unread()
    lacking = [side for side in sides if not keys.has_coefficients(side)]
    if len(lacking) == 1:
        raise InputError(
            f"the camera {lacking[0]!r} has no distortion coefficients under a known name, the other has; "
            "name them alike, or add zeros"
        )
    R, t = keys.find(_ROTATIONS), keys.find(_TRANSLATIONS)
    if R is None or t is None:
        raise InputError("holds two cameras, but not their relative pose, R and T; give its file as well")
    for camera in cameras:
        note_size(camera, document)
    pose = Pose(matrix_data(R, 9).reshape(3, 3), matrix_data(t, 3))
    return CameraSet(cameras, (pose,), _poses(root), unit)


def note_size(camera: Camera, document: Document) -> None:
    """Append a warning if the principal point is far outside the image, or its sides are exchanged.

    Raises InputError for a focal length that is not in pixels.
    """
    f, (u0, v0) = camera.intrinsics.alpha_u, camera.A[:2, 2]
    tiny = camera.image_size is None and 0 < max(u0, v0) < _SENSOR and f < 10 * _SENSOR
    if tiny or f < (_SHORTEST if camera.image_size is None else _SHORT * camera.image_size[0]):
        raise InputError(
            f"the focal length {f:.6g} is not in pixels, but in mm or relative to the image; convert the "
            "camera matrix to pixels"
        )
    if camera.image_size is None:
        return
    width, height = camera.image_size

    def off(w: int, h: int) -> float:
        return float(max(abs(u0 - (w - 1) / 2) / w, abs(v0 - (h - 1) / 2) / h))

    place = f"{document.source}: the principal point ({u0:.6g}, {v0:.6g})"
    if off(width, height) > _OFF and off(height, width) < 0.5 * off(width, height):
        document.warnings.append(
            f"{place} is far from the middle of an image of {width} x {height}, and near that of {height} x "
            f"{width}; if the file has height and width, convert it with --image-size {height} {width}"
        )
    elif max(abs(u0) / width, abs(v0) / height) < _CORNER:
        document.warnings.append(
            f"{place} is in the corner of an image of {width} x {height}; if it is counted from the middle, "
            "as in photogrammetry, add half of the size"
        )
    elif off(width, height) > _OUTSIDE:
        document.warnings.append(
            f"{place} is far outside an image of {width} x {height}; check the image size, and whether the "
            "images were cropped"
        )


def _posed(root: Field, document: Document) -> CameraSet | None:
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
    if len(found) < 2:
        return None
    cameras, poses = [], []
    for name, part in found:
        keys = LooseKeys(part, document.distortion, document.notes)
        r, t = keys.find(("rvec",)), keys.find(("tvec",))
        R = None if r is None or (turn := _flat(r, 3)).size != 3 else from_vector(turn)
        if "distCoef" in part and "R" in part:
            R, t = matrix_data(part["R"], 9).reshape(3, 3), keys.find(("t",))
        if R is None or t is None:
            return None
        stated = part.get("name").value
        cameras.append(replace(keys.camera(), name=stated if isinstance(stated, str) else name))
        keys.refuse_unread()
        note_size(cameras[-1], document)
        poses.append(Pose(R, _flat(t, 3)))
    return mounted(cameras, poses, "OpenCV", root.get("unit").value if isinstance(root.value, dict) else None)


def _within(root: Field, notes: list[str]) -> Field:
    """The mapping that holds the camera: the root, or the only one in it that does, with the other keys."""
    others: dict[str, Any] = {}
    for _ in range(_DEEPEST):
        value = root.value
        if isinstance(value, dict):
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
            cameras = [_numbers_of(part) for part in parts.values()]
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


def _sides_apart(tree: dict[str, Any]) -> dict[str, Any]:
    """The tree with the keys of the cameras of two sides, each in a mapping, beside its others."""
    for part in tree.values():  # R and T may be in a mapping as well
        if isinstance(part, dict) and {plain(str(key)) for key in part} & {"r", "t"} == {"r", "t"}:
            tree = {**part, **tree}
    names = {plain(str(key)): key for key, part in tree.items()}
    if names.keys().isdisjoint(_TRANSLATIONS):
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


def _numbers_of(tree: Any) -> list[Any] | None:
    """All that a camera says; None if it cannot be read."""
    try:
        camera = LooseKeys(_within(Field(tree, ""), [])).camera()
    except NeurocalError:
        return None
    lens = camera.distortion
    return [*camera.entries, lens.model, *lens.coefficients.tolist(), camera.image_size]


def _sides(keys: LooseKeys) -> tuple[str, str] | None:
    """Suffixes of the keys of the two cameras; None if there are no two cameras."""
    found = [pair for pair in _SIDES if all(map(keys.has_camera, pair))]
    if len(found) > 1 and {"0", "1", "2"} <= {side for pair in found for side in pair}:
        keys.root.refuse(
            "holds three cameras or more in one dictionary; save the keys of one or two as a file"
        )
    return found[0] if found else None


def _poses(root: Field) -> dict[str, Pose]:
    if "extrinsic_parameters" in root:
        rows = matrix_data(root["extrinsic_parameters"], -1)
        if len(rows) % 6:
            root["extrinsic_parameters"].fail("six numbers for each view")
        rows = rows.reshape(-1, 6)
    elif "rvecs" in root and "tvecs" in root:
        vectors = [_flat(root[key], 3).reshape(-1, 3) for key in ("rvecs", "tvecs")]
        if len(vectors[0]) != len(vectors[1]):
            root["tvecs"].fail("as many translations as there are rvecs")
        rows = np.hstack(vectors)
    else:
        return {}
    names = [f"{number}" for number in range(1, len(rows) + 1)]
    if "view_names" in root:
        names = root["view_names"].names(len(rows))
    return {name: Pose(from_vector(row[:3]), row[3:]) for name, row in zip(names, rows, strict=True)}


_ALL = ("none", "plumb_bob", "rational", "thin_prism", "tilted", "fisheye", "omnidir")


def _anything(document: Document) -> bool:
    return bool(document.tree) or isinstance(document.root.value, list)


_RIG = "`R, T`: `X_2 = R X_1 + T`; of three cameras and more `rvecs, Ts`: `X_k = R X_0 + T`"
OPENCV = Format(
    "OpenCV",
    _ALL,
    opencv_text,
    _anything,
    read,
    files="cv2.FileStorage: YAML, XML, JSON, and what people save with its names",
    poses=True,
    most_cameras=99,
    rig=_RIG,
)
JSON = Format(
    "JSON",
    _ALL,
    lambda set_, _: {"": json_text(entries(set_))},
    files="dictionary of the same names",
    skew=True,
    poses=True,
    most_cameras=99,
    rig=_RIG,
)
NPZ = Format(
    "NumPy",
    _ALL,
    lambda set_, _: {"": npz_bytes(entries(set_))},
    files=".npz; .npy of the matrix, and of the coefficients",
    skew=True,
    poses=True,
    most_cameras=99,
    rig=_RIG,
)
