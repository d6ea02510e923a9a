"""Contents of a camera file of any program, properties of formats, and cameras adapted to a format.

Poses have the forms of these programs. SciPy gets copies of rotations, because older versions refuse
read-only arrays. A camera is adapted exactly, or approximately with the loss in pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.rig import Rig, StereoRig
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.nearest_camera import Distance, NearestCamera, nearest_camera, with_model
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import InputError, plural

if TYPE_CHECKING:
    from neurocal_cli.files.exchange.format_table import Format

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
    origin: Calibration | StereoRig | Rig | None = None  # the whole contents of a neurocal file
    program: str = "OpenCV"  # that wrote the file, for messages
    # Of a ROS file, as it is: rotation (3, 3) into the rectified frame, and projection (3, 4) from there.
    rectified: tuple[Array, Array] | None = None
    focal_mm: float | None = None  # focal length, if the caller says it
    crop_factor: float | None = None  # diagonal of a 35 mm film by that of the sensor, likewise

    def __post_init__(self) -> None:
        if not self.cameras:
            raise InputError("holds no camera; give another file")
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
        film_px = (
            _FILM
            * float(np.sqrt(camera.entries[0] * camera.entries[2]))
            / np.hypot(*(camera.image_size or (np.nan, np.nan)))
        )  # focal length [mm] times the crop factor
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


def mounted(
    cameras: Sequence[Camera],
    poses: Sequence[Pose | None],
    program: str,
    unit: str | None = "m",
    frame: str = "body",
) -> CameraSet:
    """Cameras with their poses, from one frame to each; that of a single camera is its view named `frame`."""
    if not cameras:
        raise InputError("holds no camera; give another file")
    first = poses[0]
    if len(cameras) == 1:
        views = {} if first is None else {frame: first}
        return CameraSet(tuple(cameras), (), views, unit, program=program)
    known = [pose for pose in poses if pose is not None]
    relative: tuple[Pose, ...] = ()
    if len(known) == len(cameras):
        relative = tuple(after(pose, inverse(known[0])) for pose in known[1:])
    return CameraSet(tuple(cameras), relative, unit=unit, program=program)


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


def inverse(pose: Pose) -> Pose:
    """Inverse of a pose."""
    return Pose(pose.R.T, -pose.R.T @ pose.t)


def after(second: Pose, first: Pose) -> Pose:
    """Compose two poses: ``X'' = R2 (R1 X + t1) + t2``."""
    return Pose(second.R @ first.R, second.R @ first.t + second.t)


_NO_SKEW = 1e-3  # px; a smaller loss is not reported
_NO_LOSS = 5e-3  # share of the image; a smaller lost part is not reported
_AS_NEAR, _NEARER = 1.1, 0.01  # a simpler model may lose this many times more than the best, or px more

_Adaptation = tuple[Camera, NearestCamera | None, str]  # None and "" if there is no loss to report


@frozen_dataclass(eq=False)
class AdaptedCameras:
    """Cameras adapted to a format."""

    cameras: CameraSet
    losses: tuple[str, ...] = ()  # changes of the cameras and the shifts of pixels, for warnings
    remarks: tuple[str, ...] = ()  # data that are not in the file, for notes
    moved: tuple[Distance | None, ...] = ()  # shifts of the pixels of each camera


def _parts(origin: Calibration | StereoRig | Rig) -> list[Calibration]:
    """The calibrations in the contents of a neurocal file."""
    if isinstance(origin, Rig):
        return list(origin.cameras.values())
    return [origin] if isinstance(origin, Calibration) else [origin.left, origin.right]


def adapt_cameras(
    cameras: CameraSet, target: Format, force: bool, model: str | None = None
) -> AdaptedCameras:
    """Adapt cameras to a format, and to a distortion model (one of `MODELS`) if one is given.

    If the format's programs ignore skew, it is always removed; otherwise it would be ignored silently. The
    nearest camera without skew moves pixels less than ignoring the skew. An InputError says that the format
    cannot represent the distortion model (unless `force` accepts the nearest one of another model), the
    number of cameras, or an unknown unit or image size.
    """
    if len(cameras.cameras) > target.most_cameras:
        raise InputError(
            f"a file of {target.program} holds {plural(target.most_cameras, 'camera')} at most, and there "
            f"are {len(cameras.cameras)}; write another format"
        )
    if target.needs_size and any(camera.image_size is None for camera in cameras.cameras):
        raise InputError(f"a file of {target.program} needs the size of the images; give --image-size W H")
    # ROS and mrcal write the pose of a camera in its own frame, which tells nothing.
    poses = () if target.poses else cameras.poses.values()
    n_views = sum(not np.array_equal(pose.D, np.eye(3, 4)) for pose in poses)
    if target.metres:
        cameras = (cameras if target.poses else replace(cameras, poses={})).in_metres()
    if model is not None and model not in target.models:
        held = ", ".join(target.models)
        raise InputError(f"{target.program} has no distortion model {model}; choose one of {held}")
    losses, remarks, adapted, moved = [], [], [], []
    origin = cameras.origin
    # Pixels of the points with which each camera was calibrated.
    seen: list[Array | None] = [None] * len(cameras.cameras)
    if origin is not None:
        seen = [part.points.pixels for part in _parts(origin)]
    for camera, points in zip(cameras.cameras, seen, strict=True):
        new, near, loss = _adapted(camera, target, model, force, points)
        squared, moves = _squared(new) if target.square else (new, 0.0)
        adapted.append(squared)
        losses += [f"{camera.name}: {loss}"] if loss else []
        if moves > _NO_SKEW:
            losses.append(
                f"{camera.name}: {target.program} has square pixels, and those of the camera are not; the "
                f"mean focal length moves pixels by {moves:.3g} px at most"
            )
        moved.append(None if near is None else near.over_image)
    changed = any(new is not old for new, old in zip(adapted, cameras.cameras, strict=True))
    own = target.program == "neurocal"
    if origin is not None and (changed or not own):
        remarks.append(
            f"a file of {target.program} has no place for standard deviations, points and the verdict"
            if not own
            else "the new camera has no standard deviations, points and verdict"
        )
    if n_views:
        remarks.append(f"a file of {target.program} has no place for the poses of {plural(n_views, 'view')}")
    if cameras.rectified is not None and not target.rectified:
        R, P = cameras.rectified
        plain = np.column_stack([cameras.cameras[0].A, np.zeros(3)])
        if not (np.array_equal(R, np.eye(3)) and np.array_equal(P, plain)):
            remarks.append(
                f"a file of {target.program} has no place for the rectification R, P of the ROS file"
            )
    found = replace(cameras, cameras=tuple(adapted), origin=None if changed or not own else origin)
    return AdaptedCameras(found, tuple(losses), tuple(remarks), tuple(moved))


def _adapted(
    camera: Camera, target: Format, wanted: str | None, force: bool, points: Array | None
) -> _Adaptation:
    models = target.models if wanted is None else (wanted,)
    lenses = (with_model(camera.distortion, model) for model in models)
    exact = next((lens for lens in lenses if lens is not None), None)
    straight = target.holds_skew or not camera.intrinsics.skewed
    if exact is not None and straight:
        # The same object tells the caller that nothing changed.
        return camera if exact is camera.distortion else replace(camera, distortion=exact), None, ""
    if wanted is not None:
        near = nearest_camera(camera, wanted, target.holds_skew, points)
        return near.camera, near, f"the nearest {wanted}{'' if straight else ' without skew'} {_pixels(near)}"
    if exact is not None:
        near = nearest_camera(camera, exact.model, False, points)
        if near.over_image.max_px < _NO_SKEW:
            return _straightened(near.camera), None, ""
        what = (
            f"programs of {target.program} ignore skew, so the nearest camera without it is written; "
            f"{_pixels(near)}. Calibrate with --no-skew for one that fits the points better"
        )
        return _straightened(near.camera), near, what
    nearest = _nearest(camera, target, points)
    best = min(nearest, key=lambda n: (n.lost > _NO_LOSS, n.over_image.max_px))
    # Prefer a simpler model if it is nearly as good.
    most = max(_AS_NEAR * best.over_image.max_px, best.over_image.max_px + _NEARER)
    near = next(
        n for n in nearest if n.over_image.max_px <= most and (n.lost <= _NO_LOSS or best.lost > _NO_LOSS)
    )
    what = (
        f"{target.program} has no distortion model {camera.distortion.model}; the nearest of its models, "
        f"{near.camera.distortion.model}, {_pixels(near)}"
    )
    if not force:
        raise InputError(f"{camera.name}: {what}; give --force to write it, or calibrate with this model")
    return near.camera, near, what


def _nearest(camera: Camera, target: Format, points: Array | None) -> list[NearestCamera]:
    """The nearest camera of each model of a format that has one; if none has, the last one's InputError."""
    found = []
    for model in target.models:
        try:
            found.append(nearest_camera(camera, model, target.holds_skew, points))
        except InputError:
            if model == target.models[-1] and not found:
                raise
    return found


def _straightened(camera: Camera) -> Camera:
    """Set the angle of the axes to exactly pi/2."""
    a, _, b, u0, v0 = camera.entries
    return replace(camera, intrinsics=Intrinsics(a, b, u0, v0))


def _squared(camera: Camera) -> tuple[Camera, float]:
    """The camera with one focal length for both axes, and how many px this moves the image's corners."""
    a, _, b, u0, v0 = camera.entries
    f = float(np.sqrt(a * b))
    width, height = camera.image_size or (2 * u0, 2 * v0)
    corner = np.array([max(u0, width - u0), max(v0, height - v0)])
    moved = float(np.hypot(*(corner * (f / np.array([a, b]) - 1))))
    return replace(camera, intrinsics=Intrinsics(f, f, u0, v0)), moved


def _pixels(near: NearestCamera) -> str:
    over, at = near.over_image, near.at_points
    text = f"moves pixels by {over.rms_px:.3g} px rms and {over.max_px:.3g} px at most over the image"
    if at is not None:
        text += f", by {at.rms_px:.3g} px rms and {at.max_px:.3g} px at most where points were seen"
    if near.lost > _NO_LOSS:
        text += f", and it does not show {100 * near.lost:.0f} % of the image"
    return text
