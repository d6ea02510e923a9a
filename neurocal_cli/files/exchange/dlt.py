"""The eleven coefficients of the direct linear transformation (Abdel-Aziz and Karara 1971).

    u = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1),    v = (L5 X + ... + L8) / (the same)

They are the entries of P = A [R | t], equation (1), divided by the last. A file has eleven rows and no
header, as programs for motion capture expect. Each camera of a rig is a column, with X, Y, Z as the target
lies in the first view; of a single camera, each view is one.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.camera_set import CameraSet, Format, after

_FAR = 1e-9  # share of P's third row; a smaller last entry is 0


def coefficients(cameras: CameraSet) -> Array:
    """(11, C) coefficients of each camera of a rig, or (11, V) of each view of one camera.

    Raises InputError if there is no view, or if a camera's plane passes through the origin of X, Y, Z, where
    the coefficients are infinite.
    """
    if not cameras.poses:
        raise InputError(
            "the coefficients of a DLT hold a pose, and the file has none; give a file with views, such as "
            "neurocal calibrate writes"
        )
    views = list(cameras.poses.items())
    if len(cameras.cameras) == 1:
        placed = [(name, cameras.cameras[0], pose) for name, pose in views]
    else:
        pairs = zip(cameras.cameras, cameras.mounted, strict=True)
        placed = [(camera.name, camera, after(mounted, views[0][1])) for camera, mounted in pairs]
    found = []
    for name, camera, pose in placed:
        P = camera.A @ pose.D
        if abs(P[2, 3]) <= _FAR * np.abs(P[2]).max():
            raise InputError(
                f"{name}: the origin of X, Y, Z lies in the plane of the camera, where the coefficients of a "
                "DLT are infinite; move the origin of the target"
            )
        found.append(P.ravel()[:11] / P[2, 3])
    return np.array(found).T


def _text(cameras: CameraSet, ending: str) -> dict[str, str | bytes]:
    rows = (",".join(map(repr, row)) for row in coefficients(cameras).tolist())
    return {"": "\n".join([*rows, ""])}


FORMAT = Format(
    "DLT", ("none",), _text, files="11 rows, written only", skew=True, poses=True, most_cameras=99
)
