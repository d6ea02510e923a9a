"""MATLAB's ``cameraParameters`` and ``stereoParameters`` in ``.mat`` files, and those of Bouguet's toolbox.

MATLAB counts pixels from 1, so principal points are larger than ours by 1. Its matrices multiply row vectors
from the right, so K, rotations and translations are transposed; the skew is ``IntrinsicMatrix(2, 1)``.
Bouguet's ``Calib_Results.mat`` counts from 0, multiplies column vectors, and has the skew as ``alpha_c``.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.camera_names import matrix_of
from neurocal_cli.files.exchange.document import Document, stated
from neurocal_cli.files.exchange.format_table import CameraSet, Format, PoseKeys, Tree, from_vector
from neurocal_cli.files.exchange.loose_keys import LooseKeys
from neurocal_cli.files.exchange.mat_file import MARK, lists, saved
from neurocal_cli.files.exchange.tree_paths import arrays, numbers_at
from neurocal_cli.files.tree_fields import Field

FIRST_PIXEL = 1.0  # MATLAB's coordinate of the first pixel
_CAMERAS = (
    {"IntrinsicMatrix"}, {"FocalLength", "PrincipalPoint", "RadialDistortion"}, {"K", "RadialDistortion"},
    {"K", "RDistort", "TDistort"},
)  # fmt: skip
STRUCTS = ("cameraParams", "stereoParams", "params", "intrinsics")
_OF_TWO = ("CameraParameters1", "CameraParameters2")

_SECOND = PoseKeys("RotationOfCamera2:transposed TranslationOfCamera2", from_first=True)
_VIEWS, _UNIT = ("RotationMatrices", "TranslationVectors", "ViewNames"), "WorldUnits"
_PLACES = [path.partition(":")[0] for path in _SECOND.paths]
_ROUNDED = 1e-3  # share of the focal length by which two statements of it differ at most


def _struct(document: Document) -> Field:
    """The struct of a camera or of two, or the variables of the file."""
    names = list(document.tree) if document.data.startswith(MARK) else STRUCTS[:1]
    found = [name for name in names if _is_struct(document.tree.get(name))]
    known = [name for name in STRUCTS if name in found] or (found if len(found) == 1 else [])
    return document.root[known[0]] if known else document.root


def _is_struct(value: object) -> bool:
    return isinstance(value, dict) and any(keys <= set(value) for keys in (*_CAMERAS, set(_OF_TWO)))


def _matches(document: Document) -> object:
    """Whether this is a struct of MATLAB, also in JSON, or a ``.mat`` file without another camera."""
    if document.tree and _is_struct(_struct(document).value):
        return True
    return document.data.startswith(MARK) and not LooseKeys(document.root).has_camera()


def _parts(document: Document) -> dict[str, Field]:
    root = _struct(document)
    if all(key in root for key in _OF_TWO):
        left, right = (_parameters(root[key]) for key in _OF_TWO)
        right.value.update({key: value for key, value in root.value.items() if key not in _OF_TWO})
        return {"left": left, "right": right}
    if any(keys <= set(root.value) for keys in _CAMERAS):
        return {"camera": _parameters(root)}
    if any(re.fullmatch(r"x_\d+", name) for name in root.value):
        raise InputError(
            "holds points of Bouguet's toolbox, and no camera; give it to convert without --what"
        )
    raise InputError(
        "holds no camera that can be read, and objects of MATLAB's classes can be read by MATLAB only; "
        "there, save a struct: cameraParams = toStruct(cameraParams); "
        "save('camera.mat', 'cameraParams', '-v7')"
    )


def _parameters(part: Field) -> Field:
    """The struct of a camera as cameraParameters has it, from that of cameraIntrinsics as well."""
    tree = dict(part.value)
    if "RDistort" in tree:  # DANNCE's Label3D
        tree = {"IntrinsicMatrix": tree["K"], "RadialDistortion": tree["RDistort"],
                "TangentialDistortion": tree.get("TDistort")}  # fmt: skip
    elif "IntrinsicMatrix" not in tree and "K" in tree:
        tree["IntrinsicMatrix"] = numbers_at(part, "K:transposed").tolist()
    elif "IntrinsicMatrix" not in tree:
        (fx, fy), (cx, cy) = part["FocalLength"].array(2), part["PrincipalPoint"].array(2)
        tree["IntrinsicMatrix"] = matrix_of(fx, fy, cx, cy, part.get("Skew", 0.0).number()).T.tolist()
    root = Field(tree, part.source, part.path)
    if "FocalLength" in root and "PrincipalPoint" in root:
        K = numbers_at(root, "IntrinsicMatrix:transposed")
        stated = np.array([root[name].array(2) for name in ("FocalLength", "PrincipalPoint")]).ravel()
        if len(K) == 9 and np.abs(stated - K[[0, 4, 2, 5]]).max() > _ROUNDED * K.max():
            raise InputError("FocalLength, PrincipalPoint and the matrix differ; correct the one edited")
    for key in ("RadialDistortion", "TangentialDistortion"):
        numbers_at(root, key)  # or it is missing
    return root


def _views(root: Field) -> dict[str, Pose]:
    rotations, translations, views = map(root.get, _VIEWS)
    if rotations.value is None or translations.value is None:
        return {}
    R = np.asarray(rotations.value, dtype=float).reshape(3, 3, -1)
    t = np.asarray(translations.value, dtype=float).reshape(-1, 3)
    if R.shape[2] != len(t):
        translations.fail(f"{R.shape[2]} rows")
    names = [str(name).strip() for name in views.value or ()]
    if len(names) != len(t):
        names = [f"{k}" for k in range(1, len(t) + 1)]
    return {name: Pose(R[:, :, k].T, t[k]) for k, name in enumerate(names)}


def unit_of(tree: dict[str, Any]) -> str | None:
    """Unit stated in a struct; None if there is none."""
    unit = tree.get(_UNIT)
    return {"millimeters": "mm", "centimeters": "cm", "meters": "m", "inches": "in"}.get(
        str(unit), unit if isinstance(unit, str) and unit else None
    )


def _whole(trees: list[Tree], cameras: CameraSet) -> Tree:
    for tree in trees:
        tree[_UNIT] = cameras.unit or ""
    if poses := list(cameras.poses.values()):
        stacks = np.stack([pose.R.T for pose in poses], axis=2), np.stack([pose.t for pose in poses])
        trees[0] |= zip(_VIEWS, (*stacks, np.array(list(cameras.poses), dtype=object)), strict=True)
    if len(trees) == 1:
        return {STRUCTS[0]: trees[0]}
    placed = {path: trees[1].pop(path) for path in _PLACES}
    return {STRUCTS[1]: {**dict(zip(_OF_TWO, trees, strict=True)), **placed}}


# Bouguet's toolbox: Calib_Results.mat and .m, and those of its stereo rigs.
_SCRIPT = re.compile(r"^[ \t]*fc(_left)?\s*=\s*\[", re.MULTILINE).search
_VIEW = re.compile(r"(?:omc|Tc)_(\d+)").fullmatch
_RIGHT = PoseKeys("om T", from_first=True)


def _sides(root: Field) -> list[str]:
    return [side for side in ("", "_left", "_right") if f"fc{side}" in root]


def _bouguet_parts(document: Document) -> dict[str, Field]:
    """The part of each camera, whose skew is that of its matrix."""
    root = document.root
    if _SCRIPT(document.text):
        variables = {name: np.array(value) for name, value in (stated(document.text) or {}).items()}
        root = Field(lists(variables), document.source)
    parts = {}
    for side in _sides(root):
        part = {key: root[f"{key}{side}"].value for key in ("fc", "cc", "kc")}
        part["skew"] = root.get(f"alpha_c{side}", 0.0).number() * root[f"fc{side}"].array(2)[0]
        part |= {key: value for key, value in root.value.items() if key in ("nx", "ny") or _VIEW(key)}
        if side == "_right":
            part |= {key: root[key].value for key in _RIGHT.paths}
        parts[side.removeprefix("_") or "camera"] = Field(part, root.source)
    return parts


def _bouguet_views(root: Field) -> dict[str, Pose]:
    poses = {}
    for k in sorted({int(found[1]) for key in root.value if (found := _VIEW(key))}):
        om, t = (np.ravel(root.get(f"{name}_{k}", []).value).astype(float) for name in ("omc", "Tc"))
        if len(om) == len(t) == 3 and np.isfinite([om, t]).all():  # NaN for images left out
            poses[f"{k}"] = Pose(from_vector(om), t)
    return poses


BOUGUET = Format(
    "MATLAB",
    "fc/0-1 cc/0-1",
    "plumb_bob kc/0-4",
    size="nx,ny",
    skew="skew",
    told=lambda document: (
        _SCRIPT(document.text)
        or (document.data.startswith(MARK) and _sides(document.root) in ([""], ["_left", "_right"]))
    ),
    files="Calib_Results.mat and .m of Bouguet's toolbox",
    parts=_bouguet_parts,
    pose=_RIGHT,
    views=_bouguet_views,
    poses=True,
    rig="`om, T` from the left to the right camera",
)
MATLAB = Format(
    "MATLAB",
    "IntrinsicMatrix:transposed",
    """
    k1k2p1p2 RadialDistortion/0-1 TangentialDistortion/0-1
    plumb_bob RadialDistortion/0-1 TangentialDistortion/0-1 RadialDistortion/2
    """,
    size="ImageSize/1,0",
    first_pixel=FIRST_PIXEL,
    optional="all",
    told=_matches,
    files=".mat with a struct, whose first pixel is 1",
    parts=_parts,
    pose=_SECOND,
    unit=lambda root: unit_of(root.value),
    views=_views,
    write=lambda tree: saved(arrays(tree)),
    whole=_whole,
    likely=False,
    has_skew=True,
    poses=True,
    needs_size=True,
    rig="`RotationOfCamera2`, transposed",
)
