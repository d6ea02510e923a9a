"""Formats as tables: the keys of a camera, those of its pose, where the cameras are, and what is not held.

A format is added in the module of its relatives by one `table`, before those that are less specific:

    SPOT = table(
        CameraKeys(
            "Spot",  # the program
            ("fx", "fy", "cx", "cy"),
            (Lens(("brown",), "plumb_bob", FIVE), Lens(("kb4",), "fisheye", K4)),
            model="lens",
            size=("width", "height"),
        ),
        "lens fx",  # keys by which a file is told
        "calibration of Spot, JSON",
        pose=PoseKeys(("camera_to_body",), back=True),
        write=json_text,
    )

A program whose numbers have an order in place of keys has `in_order` in its `parts`. There, too, is all that
a file says in other words, such as a principal point from the middle of the image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.camera_keys import CameraKeys
from neurocal_cli.files.exchange.camera_set import (
    STILL,
    CameraSet,
    Format,
    from_quaternion,
    from_vector,
    inverse,
    mounted,
    to_quaternion,
    to_vector,
)
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.tree_paths import at, find, numbers_at, put, split
from neurocal_cli.files.tree_fields import Field

Parts = Callable[[Document], Mapping[str, Any]]  # the tree of each camera of a file, by its name
Tree = dict[str, Any]
_SIZES = (3, 4, 9), (3,)  # numbers of a rotation and a translation


@frozen_dataclass
class PoseKeys:
    """Where a program has the pose of a camera, and in which form.

    One path is that of a matrix of 4 x 4 or 3 x 4 numbers, or of a rotation vector and a translation. Two are
    those of the rotation, a matrix, a vector or a quaternion w, x, y, z, and of the translation. Where it is
    written, ``:vector`` or ``:quaternion`` names a form that is no matrix.
    """

    paths: tuple[str, ...]
    back: bool = False  # whether the pose maps from the camera
    centre: bool = False  # whether the translation is the place of the camera, of a rotation into the camera
    needed: bool = False  # whether a file without the pose is refused
    from_first: bool = False  # whether the frame is the first camera, which has no pose
    frame: str = "body"  # the pose of a single camera is its view of this name

    def read(self, root: Field) -> Pose | None:
        """The pose; None if no part of it is there, or if all of its quaternion is 0."""
        if not self.needed and all(find(root, split(path)[0]) is None for path in self.paths):
            return None
        values = [numbers_at(root, path) for path in self.paths]
        if len(values) == 1 and len(values[0]) == 6:
            values = [values[0][:3], values[0][3:]]
        elif len(values) == 1:
            if len(values[0]) not in (12, 16):
                at(root, self.paths[0]).fail("4 x 4 numbers")
            T = values[0].reshape(-1, 4)
            values = [T[:3, :3].ravel(), T[:3, 3]]
        for path, entries, sizes in zip((self.paths[0], self.paths[-1]), values, _SIZES, strict=True):
            if len(entries) not in sizes:
                at(root, split(path)[0]).fail(f"{' or '.join(map(str, sizes))} numbers")
        rotation, t = values
        if len(rotation) == 4 and not rotation.any():
            return None
        form = {3: from_vector, 4: from_quaternion}.get(len(rotation))
        R = rotation.reshape(3, 3) if form is None else form(rotation)
        pose = Pose(R, -R @ t if self.centre else t)
        return inverse(pose) if self.back else pose

    def put(self, tree: Tree, pose: Pose) -> None:
        """Write a pose."""
        pose = inverse(pose) if self.back else pose
        form = {"vector": to_vector, "quaternion": to_quaternion}.get(self.paths[0].rpartition(":")[2])
        rotation = pose.R if form is None else form(pose.R)
        if len(self.paths) == 2:
            for path, values in zip(self.paths, (rotation, pose.t), strict=True):
                put(tree, path, values if "," not in path else values.tolist())
        elif form is None:
            put(tree, self.paths[0], np.vstack([pose.D, [0.0, 0.0, 0.0, 1.0]]))
        else:
            put(tree, self.paths[0], np.concatenate([rotation, pose.t]))


def listed(path: str) -> Parts:
    """Cameras in a list, named cam0 and so on."""
    return lambda document: {f"cam{k}": part for k, part in enumerate(at(document.root, path).items())}


Poses = Callable[[Mapping[str, Field]], Sequence[Pose | None]]  # of the cameras of a file


def table(
    keys: CameraKeys,
    matches: str | Callable[[Document], object],
    files: str,
    *,
    parts: Parts = lambda document: {"camera": document.root},
    pose: PoseKeys | Poses | None = None,
    unit: str | Callable[[Field], str | None] | None = "m",
    views: Callable[[Field], Mapping[str, Pose]] | None = None,
    finish: Callable[[CameraSet, Mapping[str, Field], Document], CameraSet] | None = None,
    project: bool = False,
    write: Callable[[Any], str | bytes] | None = None,
    whole: Callable[[list[Tree], CameraSet], Any] | None = None,
    **properties: Any,
) -> Format:
    """A format that is read, and perhaps written, by its tables.

    Parameters
    ----------
    keys : CameraKeys
        The keys of one camera.
    matches : str or callable
        Keys at the top of a file, by which it is told, or what tells it.
    files : str
        Its files, for the documentation.
    parts : callable, optional
        The tree of each camera of a file, by its name.
    pose : PoseKeys or callable, optional
        Keys of the pose in that tree, or what finds the poses of all.
    unit : str or callable, optional
        Unit of lengths, or what finds it in the tree of the first camera; None if a file does not state it.
    views : callable, optional
        What finds the poses of views in the tree of the first camera.
    finish : callable, optional
        What else is to be done with the cameras, their trees and the document.
    project : bool
        Whether the cameras of a file have no pose between them: one is read, or that which all are alike.
    write, whole : callable, optional
        How a tree becomes a text, and the trees of cameras one of a file. A format without `whole` is written
        with one camera.
    properties
        Other attributes of `Format`.
    """

    def read(document: Document) -> CameraSet:
        found = {
            name: one if isinstance(one, Field) else Field(one, document.source, name)
            for name, one in parts(document).items()
        }
        cameras = in_poses(found)
        if views is not None:
            cameras = replace(cameras, poses=views(next(iter(found.values()))))
        return cameras if finish is None else finish(cameras, found, document)

    def in_poses(found: Mapping[str, Field]) -> CameraSet:
        if project:
            one = only([keys.camera(part) for part in found.values()], found, keys.program)
            seen = {} if not isinstance(pose, PoseKeys) else {name: pose.read(p) for name, p in found.items()}
            return replace(one, poses={name: own for name, own in seen.items() if own is not None})
        cameras = [keys.camera(part, name) for name, part in found.items()]
        poses: Sequence[Pose | None] = [None] * len(cameras)
        if not isinstance(pose, PoseKeys):
            poses = poses if pose is None else pose(found)
        elif not pose.from_first:
            poses = [pose.read(part) for part in found.values()]
        elif len(cameras) > 1:
            poses = [STILL, *map(pose.read, list(found.values())[1:])]
        placed = pose is not None and not (getattr(pose, "from_first", False) and len(cameras) == 1)
        frame = getattr(pose, "frame", "body")
        stated = unit(next(iter(found.values()))) if callable(unit) else unit if placed else None
        return mounted(cameras, poses, keys.program, stated, frame)

    def text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
        assert write is not None
        trees = [keys.tree(camera) for camera in cameras.cameras]
        if isinstance(pose, PoseKeys) and made["most_cameras"] > 1:
            start = int(pose.from_first)
            for tree, placed in zip(trees[start:], cameras.mounted[start:], strict=True):
                pose.put(tree, placed)
        return {"": write(trees[0] if whole is None else whole(trees, cameras))}

    wanted = set(matches.split()) if isinstance(matches, str) else set()
    found = {
        "marks": keys.top,
        "models": keys.models,
        "skew": bool(keys.skew),
        "first_pixel": keys.first_pixel,
    }
    made: dict[str, Any] = {"read": read, **({} if write is None else {"text": text}), **found}
    made |= {"most_cameras": 2 if getattr(pose, "from_first", False) else 1, **properties}
    told = (lambda document: wanted <= set(document.tree)) if isinstance(matches, str) else matches
    return Format(keys.program, matches=told, files=files, **made)


def only(cameras: Sequence[Camera], names: Mapping[str, Any], program: str) -> CameraSet:
    """The one camera of a project; an InputError names those of several that differ."""
    if not cameras:
        raise InputError(f"is a project of {program} without a camera; calibrate it first")
    alike = {
        (*one.entries, one.distortion.model, *one.distortion.coefficients, one.image_size) for one in cameras
    }
    if len(alike) > 1:
        listed = ", ".join(name[:30] for name in names)
        raise InputError(
            f"holds several cameras of {program} ({listed}), which have no pose between them; save one as a "
            "file"
        )
    return CameraSet((cameras[0],), program=program)
