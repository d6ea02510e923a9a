"""Read known cameras and poses from files of neurocal and other programs."""

from __future__ import annotations

from pathlib import Path

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import FormatError
from neurocal_cli.io.calibration_tree import poses_from_field
from neurocal_cli.io.exchange.reading import read_cameras
from neurocal_cli.io.file_storage import read_tree
from neurocal_cli.io.files import one_line


def read_intrinsics(path: str | Path) -> Camera:
    """Read a camera without its poses.

    Parameters
    ----------
    path : str or Path
        A neurocal calibration or the file of another program, see `exchange.reading`; ``-`` is stdin.

    Raises
    ------
    FormatError
        There is no valid camera matrix, or more than one camera.
    """
    found = read_cameras([path], whole=False)
    if len(found.cameras) > 1:
        source = "<stdin>" if str(path) == "-" else one_line(path)
        raise FormatError("is a stereo rig; give the file of one camera", source)
    return found.cameras[0]


def read_extrinsics(path: str | Path) -> dict[str, Pose]:
    """Read the pose of each view of a neurocal calibration; ``-`` is stdin.

    Raises
    ------
    FormatError
        The file cannot be read or has no poses.
    """
    return poses_from_field(read_tree(path))
