"""Cameras adapted to a format: exactly, or approximately with the loss in pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.nearest_camera import Distance, NearestCamera, nearest_camera, with_model
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import InputError, plural
from neurocal_cli.files.exchange.format_table import CameraSet, Format

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
    if target.unit == "m":
        cameras = (cameras if target.poses else replace(cameras, poses={})).in_metres()
    if model is not None and model not in target.models:
        held = ", ".join(target.models)
        raise InputError(f"{target.program} has no distortion model {model}; choose one of {held}")
    losses, remarks, adapted, moved = [], [], [], []
    origin = cameras.origin
    # Pixels of the points with which each camera was calibrated.
    seen: list[Array | None] = [None] * len(cameras.cameras)
    if origin is not None:
        parts = [origin] if isinstance(origin, Calibration) else origin.cameras.values()
        seen = [part.points.pixels for part in parts]
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
