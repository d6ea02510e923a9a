"""Formats as tables: the keys of a camera, those of its pose, where the cameras are, and what is not held.

A format is added in the module of its relatives by one `Format`, before those that are less specific:

    SPOT = Format(
        "Spot",  # the program
        "fx,fy,cx,cy",
        '''
        brown: plumb_bob *
        kb4: fisheye *
        ''',
        model="lens",
        size="width,height",
        told="lens fx",
        files="calibration of Spot, JSON",
        pose=PoseKeys("camera_to_body", back=True),
        write=json_text,
    )

A program whose numbers have an order in place of keys has `in_order` in its `parts`. There, too, is all that
a file says in other words, such as a principal point from the middle of the image.

What a file holds is a `CameraSet`, and poses have the forms of these programs. SciPy gets copies of
rotations, because older versions refuse read-only arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.camera_keys import CameraKeys
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.tree_paths import at, find, numbers_at, put, split
from neurocal_cli.files.tree_fields import Field

_FILM = float(np.hypot(36.0, 24.0))  # diagonal [mm]
STILL = Pose(np.eye(3), np.zeros(3))
METRES = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "in": 0.0254}


@frozen_dataclass(eq=False)
class CameraSet:
    """One camera, or several that are fixed to each other."""

    cameras: tuple[Camera, ...]
    relative: tuple[Pose, ...] = ()  # from the first camera to each further one, X_k = R X_0 + t
    poses: Mapping[str, Pose] = field(default_factory=dict)  # of views, from the world to the first camera
    unit: str | None = None  # of the translations; None if the file does not state it
    origin: Calibration | Rig | None = None  # the whole contents of a neurocal file
    program: str = "OpenCV"  # that wrote the file, for messages
    # Of a ROS file, as it is: rotation (3, 3) into the rectified frame, and projection (3, 4) from there.
    rectified: tuple[Array, Array] | None = None
    focal_mm: float | None = None  # focal length, if the caller says it
    crop_factor: float | None = None  # diagonal of a 35 mm film by that of the sensor, likewise

    def __post_init__(self) -> None:
        if len(self.relative) != len(self.cameras) - 1:
            raise InputError(
                f"holds {len(self.cameras)} cameras, but not their relative poses; give a file with "
                "one camera, or with the poses"
            )

    @property
    def mounted(self) -> tuple[Pose, ...]:
        """Poses from the first camera to each of them."""
        return (STILL, *self.relative)

    @property
    def has_lengths(self) -> bool:
        """Whether there is any translation, so that the unit matters."""
        return bool(self.relative or self.poses)

    def lens(self) -> tuple[float | None, float | None, float | None]:
        """Focal length [mm] and crop factor of the first camera, each from the other, and its true length.

        The last is known if both were given: the first is then that which is engraved on the lens.
        """
        camera = self.cameras[0]
        diagonal = np.hypot(*(camera.image_size or (np.nan, np.nan)))
        # Focal length [mm] times the crop factor.
        film_px = _FILM * float(np.sqrt(camera.entries[0] * camera.entries[2])) / diagonal
        focal, crop = self.focal_mm, self.crop_factor
        if focal is None and crop is not None:
            return film_px / crop, crop, None
        if crop is None and focal is not None:
            return focal, film_px / focal, None
        return focal, crop, None if crop is None else film_px / crop

    def in_metres(self) -> CameraSet:
        """Convert the translations to metres; raise an InputError if the unit is unknown or not a length."""
        if not self.has_lengths:
            return self
        if self.unit not in METRES:
            stated = "not known" if self.unit in (None, "unknown") else repr(self.unit)
            raise InputError(
                f"the file is to be in metres, but the unit of {self.program}'s file is {stated}; give "
                f"--unit, one of {', '.join(METRES)}"
            )
        scale = METRES[self.unit]
        return replace(
            self,
            relative=tuple(Pose(pose.R, scale * pose.t) for pose in self.relative),
            poses={name: Pose(pose.R, scale * pose.t) for name, pose in self.poses.items()},
            unit="m",
        )


def to_vector(R: Array) -> Array:
    """Rotation vector (axis times angle [rad]) of a rotation (3, 3), like ``cv2.Rodrigues``; also near pi."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(np.array(R)).as_rotvec())


def from_vector(r: Array) -> Array:
    """Rotation (3, 3) of a rotation vector (axis times angle [rad])."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(np.array(r, dtype=float).reshape(3)).as_matrix())


def to_quaternion(R: Array) -> Array:
    """Unit quaternion w, x, y, z of a rotation (3, 3), with w >= 0."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(np.array(R)).as_quat()
    return np.array([w, x, y, z]) * (1.0 if w >= 0 else -1.0)


def from_quaternion(q: Array) -> Array:
    """Rotation (3, 3) of a quaternion w, x, y, z of any non-zero length."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(np.roll(np.asarray(q, dtype=float), -1)).as_matrix())


Tree = dict[str, Any]
Parts = Mapping[str, Field]  # the tree of each camera of a file, by its name
_SIZES = (3, 4, 9), (3,)  # numbers of a rotation and a translation


@frozen_dataclass
class PoseKeys:
    """Where a program has the pose of a camera, and in which form.

    One path is that of a matrix of 4 x 4 or 3 x 4 numbers, or of a rotation vector and a translation. Two are
    those of the rotation, a matrix, a vector or a quaternion w, x, y, z, and of the translation. Where it is
    written, ``:vector`` or ``:quaternion`` names a form that is no matrix.
    """

    keys: str
    back: bool = False  # whether the pose maps from the camera
    centre: bool = False  # whether the translation is the place of the camera, of a rotation into the camera
    needed: bool = False  # whether a file without the pose is refused
    from_first: bool = False  # whether the frame is the first camera, which has no pose
    frame: str = "body"  # the pose of a single camera is its view of this name

    @property
    def paths(self) -> list[str]:
        """The path of the pose, or those of the rotation and of the translation."""
        return self.keys.split()

    def read(self, root: Field) -> Pose | None:
        """The pose; None if no part of it is there, or if all of its quaternion is 0."""
        if not self.needed and all(find(root, split(path)[0]) is None for path in self.paths):
            return None
        values = [numbers_at(root, path) for path in self.paths]
        if len(values) == 1 and len(values[0]) == 6:
            values = [values[0][:3], values[0][3:]]
        elif len(values) == 1:
            if len(values[0]) not in (12, 16):
                at(root, self.keys).fail("4 x 4 numbers")
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
        return pose.inverse if self.back else pose

    def put(self, tree: Tree, pose: Pose) -> None:
        """Write a pose."""
        pose = pose.inverse if self.back else pose
        form = {"vector": to_vector, "quaternion": to_quaternion}.get(self.paths[0].rpartition(":")[2])
        rotation = pose.R if form is None else form(pose.R)
        if len(self.paths) == 2:
            for path, values in zip(self.paths, (rotation, pose.t), strict=True):
                put(tree, path, values if "," not in path else values.tolist())
        elif form is None:
            put(tree, self.keys, np.vstack([pose.D, [0.0, 0.0, 0.0, 1.0]]))
        else:
            put(tree, self.keys, np.concatenate([rotation, pose.t]))


@frozen_dataclass(eq=False)
class Format(CameraKeys):
    """A format that is read, and perhaps written, by its tables.

    One that is not told is not read.
    """

    files: str = ""  # its files, for the documentation
    told: str | Callable[[Document], object] = ""  # keys at the top of a file, or what tells it
    # What finds the trees of the cameras, or the path of a list of them. Without it, a file is told by these
    # trees, or it is one.
    parts: Callable[[Document], Mapping[str, Field | Tree]] | str = ""
    pose: PoseKeys | Callable[[Parts], Sequence[Pose | None]] | None = None  # keys of it, or what finds all
    unit: str | Callable[[Field], str | None] | None = None  # of lengths, or what finds it in the first tree
    views: Callable[[Field], Mapping[str, Pose]] | None = None  # what finds those of views in the first tree
    # Notes by key, for numbers that are neither 0 nor 1; {} is the number.
    remarks: Mapping[str, str] = field(default_factory=dict)
    finish: Callable[[CameraSet, Parts, Document], CameraSet] | None = None  # what else is to be done
    project: bool = False  # whether the cameras have no pose between them: one is read, or all are alike
    reader: Callable[[Document], CameraSet] | None = None  # in place of all of these
    write: Callable[[Any], str | bytes] | None = None  # how a tree becomes a text
    whole: Callable[[list[Tree], CameraSet], Any] | None = None  # the trees of cameras as one of a file
    # From the cameras and the extension of the output, such as ".xml": the files by name, "" if there is one.
    texts: Callable[[CameraSet, str], Mapping[str, str | bytes]] | None = None
    written: tuple[str, ...] = ()  # the models that are written, if not all of them
    likely: bool = True  # whether files that are no camera may be like it by their keys
    has_skew: bool = False  # whether its programs support skew, if no key tells it
    poses: bool = False  # whether it contains the poses of views
    at_most: int | None = None  # cameras: if it is not told, one, or any number of a rig
    needs_size: bool = False  # whether the image size must be known
    rectified: bool = False  # whether it contains the rectification of a camera
    square: bool = False  # whether its pixels are square
    rig: str = ""  # how the poses of several cameras are stated, for the documentation

    @property
    def models(self) -> tuple[str, ...]:
        """Our names of the models that are written, the simplest first."""
        return self.written or super().models

    @property
    def to(self) -> str:
        """The value of the option ``--to``."""
        return {"NumPy": "npz"}.get(self.program, self.program.lower())

    @property
    def holds_skew(self) -> bool:
        """Whether its programs support skew."""
        return self.has_skew or bool(self.skew)

    @property
    def most_cameras(self) -> int:
        """How many cameras a file holds at most."""
        pair = isinstance(self.pose, PoseKeys) and self.pose.from_first
        return self.at_most or (2 if pair else 99 if self.rig else 1)

    @property
    def is_written(self) -> bool:
        """Whether it is written."""
        return self.write is not None or self.texts is not None

    def matches(self, document: Document) -> object:
        """Whether a file is of this format."""
        if isinstance(self.told, str):
            return self.told and set(self.told.split()) <= set(document.tree)
        return self.told(document)

    def read(self, document: Document, told: object) -> CameraSet:
        """Read the cameras of a file, from what told that it is of this format."""
        if self.reader is not None:
            return self.reader(document)
        parts: Mapping[str, Field | Tree]
        if callable(self.parts):
            parts = self.parts(document)
        elif self.parts:
            parts = {f"cam{k}": part for k, part in enumerate(at(document.root, self.parts).items())}
        else:
            parts = told if isinstance(told, dict) else {"camera": document.root}
        found = {
            name: one if isinstance(one, Field) else Field(one, document.source, name)
            for name, one in parts.items()
        }
        for part in found.values():
            for path, remark in self.remarks.items():
                if (stated := find(part, path)) is not None and (number := stated.number()) not in (0.0, 1.0):
                    document.note(remark.format(number))
        cameras = self._of_project(found) if self.project else self._mounted(found)
        if self.views is not None:
            cameras = replace(cameras, poses=self.views(next(iter(found.values()))))
        return cameras if self.finish is None else self.finish(cameras, found, document)

    def _mounted(self, found: Parts) -> CameraSet:
        """The cameras with the poses between them; that of a single camera is its view."""
        if not found:
            raise InputError("holds no camera; give another file")
        cameras = tuple(self.camera(part, name) for name, part in found.items())
        first, *others = found.values()
        poses: Sequence[Pose | None] = []
        if callable(self.pose):
            poses = self.pose(found)
        elif self.pose is not None and (others or not self.pose.from_first):
            start = STILL if self.pose.from_first else self.pose.read(first)
            poses = [start, *map(self.pose.read, others)]
        known = [pose for pose in poses if pose is not None]
        relative: tuple[Pose, ...] = ()
        views: dict[str, Pose] = {}
        if not others:
            views = {getattr(self.pose, "frame", "body"): pose for pose in known}
        elif len(known) == len(cameras):
            relative = tuple(pose.relative_to(known[0]) for pose in known[1:])
        unit = self.unit(first) if callable(self.unit) else self.unit if poses else None
        return CameraSet(cameras, relative, views, unit, program=self.program)

    def _of_project(self, found: Parts) -> CameraSet:
        """The camera of a project, or that which all are alike, with its poses."""
        cameras = [self.camera(part) for part in found.values()]
        if not cameras:
            raise InputError(f"is a project of {self.program} without a camera; calibrate it first")
        alike = {
            (*one.entries, one.distortion.model, *one.distortion.coefficients, one.image_size)
            for one in cameras
        }
        if len(alike) > 1:
            names = ", ".join(name[:30] for name in found)
            raise InputError(
                f"holds several cameras of {self.program} ({names}), which have no pose between them; save "
                "one as a file"
            )
        poses = {}
        if isinstance(self.pose, PoseKeys):
            poses = {name: pose for name, part in found.items() if (pose := self.pose.read(part)) is not None}
        return CameraSet((cameras[0],), poses=poses, program=self.program)

    def text(self, cameras: CameraSet, ending: str) -> Mapping[str, str | bytes]:
        """Write cameras that fit the format."""
        if self.texts is not None:
            return self.texts(cameras, ending)
        assert self.write is not None
        trees = [self.tree(camera) for camera in cameras.cameras]
        if isinstance(self.pose, PoseKeys) and self.most_cameras > 1:
            start = int(self.pose.from_first)
            for tree, placed in zip(trees[start:], cameras.mounted[start:], strict=True):
                self.pose.put(tree, placed)
        return {"": self.write(trees[0] if self.whole is None else self.whole(trees, cameras))}
