"""OpenPTV: the orientation of a camera, ``.ori``, its distortion, ``.addpar``, and the pixels of ``ptv.par``.

All is in mm on the sensor, from its middle, with y up and z towards the viewer; the centre of the first pixel
is (1/2, 1/2). Brown's polynomial is that of OpenCV, but about the middle of the sensor and not about the
principal point. If these differ, the camera becomes the nearest one, and a warning tells how near.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.exchange.camera_set import CameraSet, Format, mounted
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.reading import read_text
from neurocal_cli.files.tree_fields import Field, is_number

_ORIENTATION = [3, 3, 3, 3, 3, 2, 1, 3]  # numbers in the lines: place, angles, R, principal point, f, glass
_FLIP = np.diag([1.0, -1.0, -1.0])
_GRID, _WORST = 15, 3.0  # rays along each side of the image; px by which a camera may differ
_PAR = ("ptv.par", "../parameters/ptv.par", "parameters/ptv.par", "../ptv.par")


def numbers_in_lines(document: Document) -> list[int]:
    """How many numbers each line has; none if there are words, or many lines."""
    lines = [line.split() for line in document.text[:2000].splitlines() if line.strip()]
    return [len(line) for line in lines] if all(is_number(w) for line in lines for w in line) else []


def _pixels(path: Path) -> tuple[list[float], bool]:
    """Width and height [px], the sides of a pixel [mm], and whether rays are broken at glass."""
    for place in _PAR:
        if (path.parent / place).exists():
            text, source = read_text(path.parent / place)
            words = text.split()
            rest = words[1 + 2 * int(words[0]) :] if words and words[0].isdecimal() else []
            values = Field(rest[3:11], source, "the lines from imx on").array(8).tolist()
            if min(values[:4]) <= 0 or any(side % 1 for side in values[:2]):
                raise FormatError("the size of the images or of the pixels is none; correct it", source)
            return values[:4], len(set(values[5:8])) > 1
    raise InputError(
        "is an orientation of OpenPTV, in mm of the sensor; put ptv.par, which has the size of the pixels, "
        f"beside it, or give it in its folder cal beside {_PAR[1][3:]}"
    )


def _read(document: Document) -> CameraSet:
    values = Field(document.text.split(), document.source, "the file").array(sum(_ORIENTATION))
    path = Path(document.source)
    (width, height, du, dv), broken = _pixels(path)
    lens = path.with_suffix(".addpar")
    k = np.array([0, 0, 0, 0, 0, 1.0, 0])  # k1, k2, k3, p1, p2, scale, shear
    if lens.exists():
        text, source = read_text(lens)
        k = Field(text.split(), source, "the file").array(7)
    else:
        document.warnings.append(f"{document.source}: there is no {lens.name}, so it has no distortion")
    centre, f = values[15:17], float(values[17])
    camera = _camera(centre, f, k, (int(width), int(height)), (du, dv), document, path.name.split(".")[0])
    R = _FLIP @ values[6:15].reshape(3, 3).T
    if broken:
        document.notes.append(f"{document.source}: rays are broken at glass, so its pose is left out")
    pose = None if broken else Pose(R, -R @ values[:3])
    return mounted([camera], [pose], "OpenPTV", "mm", "world")


def _camera(
    centre: Array,
    f: float,
    k: Array,
    size: tuple[int, int],
    side: tuple[float, float],
    document: Document,
    name: str,
) -> Camera:
    k1, k2, k3, p1, p2, scale, shear = k.tolist()
    affine = np.array([[scale, np.sin(shear)], [0.0, np.cos(shear)]]) / np.array(side)[:, None]
    middle = 0.5 * np.array(size) - 0.5
    origin = centre * [1, -1]  # y down

    def intrinsics(entries: Array) -> Intrinsics:
        a, skew, b, u0, v0 = entries
        return Intrinsics.from_matrix(np.array([[a, skew, u0], [0.0, b, v0], [0.0, 0.0, 1.0]]))

    start = np.array([*(f * affine).ravel()[[0, 1, 3]], *(affine @ origin + middle)])
    lens = np.array([k1 * f**2, k2 * f**4, -p2 * f, p1 * f, k3 * f**6])
    exact = Camera(
        intrinsics(start), Distortion("plumb_bob", lens) if lens.any() else Distortion(), size, name
    )
    if not (lens.any() and origin.any()):
        return exact
    # Pixels of rays by OpenPTV's formula, and the camera of OpenCV's that is nearest to them.
    from scipy.optimize import least_squares

    corner = np.abs(np.linalg.inv(affine)) @ (0.5 * np.array(size))
    grid = np.stack(np.meshgrid(*(np.linspace(-c, c, _GRID) for c in corner)), axis=-1).reshape(-1, 2)
    x, y = grid.T
    r = x**2 + y**2
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
    bent = [
        x * radial + p1 * (r + 2 * x**2) - 2 * p2 * x * y,
        y * radial - p2 * (r + 2 * y**2) + 2 * p1 * x * y,
    ]
    pixels = np.array(bent).T @ affine.T + middle
    rays = np.column_stack([(grid - origin) / f, np.ones(len(grid))])

    def of(values: Array) -> Camera:
        return Camera(intrinsics(values[:5]), Distortion("plumb_bob", values[5:]), size, name)

    def errors(values: Array) -> Array:
        return (np.nan_to_num(of(values).project(rays)[0], nan=1e6) - pixels).ravel()

    unit = np.array([*np.maximum(np.abs(start), 1.0), 0.1, 0.1, 0.01, 0.01, 0.1])
    found = least_squares(errors, np.array([*start, *lens]), x_scale=unit)
    worst = float(np.hypot(*found.fun.reshape(-1, 2).T).max())
    if worst > _WORST:
        raise InputError(
            f"no camera of OpenCV's is within {_WORST:g} px of this one; calibrate from its points"
        )
    document.warnings.append(
        f"{document.source}: OpenPTV's distortion is about the middle of the sensor; the nearest camera "
        f"about the principal point moves pixels by {worst:.2g} px at most"
    )
    return of(found.x)


FORMAT = Format(
    "OpenPTV",
    ("none", "plumb_bob"),
    matches=lambda document: numbers_in_lines(document) == _ORIENTATION,
    read=_read,
    files=".ori with its .addpar, and ptv.par beside it or in ../parameters",
    skew=True,
    first_pixel=0.5,
)
