"""What of a camera set a format can hold: exactly, nearly or not at all, with the loss in pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.distortion.nearest_camera import NearestCamera, nearest_camera, with_model
from neurocal_cli.errors import InputError
from neurocal_cli.io.exchange.camera_set import CameraSet, Format

__all__ = ["Fitted", "fitted_in"]

_NO_SKEW = 1e-3  # a loss below this [px] is nobody's concern


@dataclass(frozen=True, eq=False)
class Fitted:
    """Cameras as a format can hold them.

    Attributes
    ----------
    cameras : CameraSet
    losses : tuple of str
        What is not as it was, with the pixels that it makes, for a warning.
    remarks : tuple of str
        What is not in the file, for a note.
    """

    cameras: CameraSet
    losses: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


def fitted_in(cameras: CameraSet, target: Format, force: bool) -> Fitted:
    """Make cameras fit a format.

    Skew that the format's programs ignore is taken out always: written, it would be ignored silently.
    The nearest camera without skew moves pixels by less than the ignored skew does.

    Parameters
    ----------
    cameras : CameraSet
    target : Format
    force : bool
        Whether the nearest camera of another distortion model will do.

    Raises
    ------
    InputError
        What the format cannot hold: a distortion model unless forced, too many cameras, an unknown unit or
        image size.
    """
    if len(cameras.cameras) > target.most_cameras:
        raise InputError(
            f"a file of {target.program} holds {target.most_cameras} cameras at most, and there are "
            f"{len(cameras.cameras)}; write another format"
        )
    if target.needs_size and any(camera.image_size is None for camera in cameras.cameras):
        raise InputError(f"a file of {target.program} needs the size of the images; give --image-size W H")
    if target.metres:
        cameras = (cameras if target.poses else replace(cameras, poses={})).in_metres()
    losses, remarks, fitted = [], [], []
    for camera in cameras.cameras:
        new, loss = _fitted(camera, target, force)
        fitted.append(new)
        losses += [f"{camera.name}: {loss}"] if loss else []
    changed = any(new is not old for new, old in zip(fitted, cameras.cameras, strict=True))
    own = target.program == "neurocal"
    if cameras.origin is not None and not own:
        remarks.append(
            f"a file of {target.program} has no place for standard deviations, points and the verdict"
        )
    if cameras.poses and not target.poses:
        remarks.append(f"a file of {target.program} has no place for the poses of {len(cameras.poses)} views")
    origin = cameras.origin if own and not changed else None
    return Fitted(replace(cameras, cameras=tuple(fitted), origin=origin), tuple(losses), tuple(remarks))


def _fitted(camera: Camera, target: Format, force: bool) -> tuple[Camera, str]:
    model = next((m for m in target.models if with_model(camera.distortion, m) is not None), None)
    straight = target.skew or not camera.intrinsics.skewed
    if model is not None and straight:
        return _as_model(camera, model), ""
    if model is not None:
        near = nearest_camera(camera, model, skew=False)
        if near.max_px < _NO_SKEW:
            return _straightened(near.camera), ""
        return _straightened(near.camera), (
            f"programs of {target.program} ignore skew, so the nearest camera without it is written; "
            f"{_pixels(near)}. Calibrate with --no-skew for one that fits the points better"
        )
    near = min((nearest_camera(camera, m, target.skew) for m in target.models), key=lambda n: n.max_px)
    what = (
        f"{target.program} has no distortion model {camera.distortion.model}; the nearest of its models, "
        f"{near.camera.distortion.model}, {_pixels(near)}"
    )
    if not force:
        raise InputError(f"{camera.name}: {what}; give --force to write it, or calibrate with this model")
    return near.camera, what


def _as_model(camera: Camera, model: str) -> Camera:
    """The camera under the name of a model that holds its distortion; itself if it has that name."""
    distortion = with_model(camera.distortion, model)
    if distortion is camera.distortion or distortion is None:
        return camera
    return replace(camera, distortion=distortion)


def _straightened(camera: Camera) -> Camera:
    """A camera whose angle of the axes is pi/2 to the last bit."""
    a, _, b, u0, v0 = camera.entries
    return replace(camera, intrinsics=Intrinsics(a, b, u0, v0))


def _pixels(near: NearestCamera) -> str:
    return f"moves pixels by {near.rms_px:.3g} px rms and {near.max_px:.3g} px at most over the image"
