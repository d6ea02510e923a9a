"""Contents of a camera file of any program, and poses in the forms of these programs.

SciPy gets copies of rotations, because older versions refuse read-only arrays.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace

import numpy as np

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.rig import Rig, StereoRig
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError

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


def inverse(pose: Pose) -> Pose:
    """Inverse of a pose."""
    return Pose(pose.R.T, -pose.R.T @ pose.t)


def after(second: Pose, first: Pose) -> Pose:
    """Compose two poses: ``X'' = R2 (R1 X + t1) + t2``."""
    return Pose(second.R @ first.R, second.R @ first.t + second.t)
