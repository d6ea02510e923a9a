"""Contents of a camera file of any program, and properties of the formats."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, replace

from neurocal_cli.calibration import Calibration
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.stereo.rig import Rig

METRES = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "in": 0.0254}


@frozen_dataclass(eq=False)
class CameraSet:
    """One camera, or several that are fixed to each other.

    Attributes
    ----------
    cameras : tuple of Camera
    relative : tuple of Pose
        From the first camera to each further one: ``X_k = R X_0 + t``; one less than the cameras.
    poses : dict of Pose by view
        From the world to the first camera.
    unit : str, optional
        Of the translations; None if the file does not state it.
    origin : Calibration or Rig, optional
        The whole contents of a neurocal file.
    program : str
        Name of the program that wrote the file, for messages.
    """

    cameras: tuple[Camera, ...]
    relative: tuple[Pose, ...] = ()
    poses: Mapping[str, Pose] = field(default_factory=dict)
    unit: str | None = None
    origin: Calibration | Rig | None = None
    program: str = "OpenCV"

    def __post_init__(self) -> None:
        if len(self.relative) != len(self.cameras) - 1:
            raise InputError(
                f"holds {len(self.cameras)} cameras, but not their relative poses; give a file with "
                "one camera, or with the poses"
            )

    @property
    def has_lengths(self) -> bool:
        """Whether there is any translation, so that the unit matters."""
        return bool(self.relative or self.poses)

    def in_metres(self) -> CameraSet:
        """Convert the translations to metres.

        Raises
        ------
        InputError
            The unit is unknown or not a length.
        """
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


@frozen_dataclass
class Format:
    """Capabilities of a file format, and the function that writes it.

    Attributes
    ----------
    program : str
        Name for messages.
    models : tuple of str
        Our names of its distortion models, the simplest first.
    skew : bool
        Whether its programs support skew.
    poses : bool
        Whether it contains the poses of views.
    most_cameras : int
    metres : bool
        Whether lengths are in metres.
    needs_size : bool
        Whether the image size must be known.
    text : callable
        Returns the contents of the files by name; "" is the name of a single file. The arguments are the
        cameras, which must fit the format, and the extension of the output, such as ".xml".
    """

    program: str
    models: tuple[str, ...]
    skew: bool
    poses: bool
    most_cameras: int
    metres: bool
    needs_size: bool
    text: Callable[[CameraSet, str], Mapping[str, str | bytes]]
