"""Cameras whose radius is another function of the angle, as the nearest fisheye: OCamCalib, the FOV model.

The curve of the radius over the angle is fitted by f (theta + k1 theta^3 + ... + k4 theta^9), and the largest
difference over the image is told, in pixels.
"""

from __future__ import annotations

import re

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.camera_set import CameraSet, Format
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.tree_fields import Field, is_number

_SAMPLES = 400  # of the curve, from the centre to the farthest corner
_WORST = 3.0  # px; a camera that differs more is refused
_STRAIGHT = 1e-7  # omega of a lens without distortion


def fitted(
    theta: Array, radius: Array, scale: float, document: Document, model: str
) -> tuple[float, Distortion]:
    """Factor of the focal length and lens of the fisheye nearest to a curve; a warning tells how near.

    theta (N,) [rad]; radius (N,), of `scale` px for 1.
    """
    powers = theta[:, None] ** np.arange(1, 10, 2)
    c = np.linalg.lstsq(powers, radius, rcond=None)[0]
    error = np.abs(powers @ c - radius).max() * scale
    if error > _WORST or c[0] <= 0:
        raise InputError(
            f"the {model} of this camera is no fisheye within {_WORST:g} px, but {error:.3g}; calibrate its "
            "images as fisheye, omnidir or rich"
        )
    document.warnings.append(
        f"{document.source}: {model} is no model here; the nearest fisheye moves pixels by {error:.2g} px "
        "at most"
    )
    return float(c[0]), Distortion("fisheye", c[1:] / c[0])


def fov(camera: Camera, omega: float, document: Document) -> Camera:
    """A camera of Devernay and Faugeras (2001): r = atan(2 tan(theta) tan(omega / 2)) / omega."""
    if abs(omega) < _STRAIGHT:
        return camera
    fx, _, fy, u0, v0 = camera.entries
    width, height = camera.image_size or (2 * u0, 2 * v0)
    corner = np.hypot(max(u0, width - u0) / fx, max(v0, height - v0) / fy)
    radius = np.linspace(0, min(corner, 0.99 * np.pi / 2 / omega), _SAMPLES)
    theta = np.arctan2(np.sin(radius * omega), 2 * np.tan(omega / 2) * np.cos(radius * omega))
    f, lens = fitted(theta, radius, max(fx, fy), document, f"the FOV model with omega = {omega:g}")
    return Camera(Intrinsics(f * fx, f * fy, u0, v0), lens, camera.image_size, camera.name)


# OCamCalib (Scaramuzza 2006). A pixel is [row, column] = [[c, d], [e, 1]] rho (x, y) / |(x, y)| + centre,
# with x down and y right, and the ray (x, y, f(rho)) has z backwards.
_MARK = "polynomial coefficients for the DIRECT mapping"


def _read_ocam(document: Document) -> CameraSet:
    rows = [line.split() for line in document.text.splitlines() if line.strip() and line.lstrip()[0] != "#"]
    if [len(row) for row in rows[2:5]] != [2, 3, 2] or not all(is_number(w) for row in rows for w in row):
        raise InputError(
            "is a damaged file of OCamCalib: it has not all its blocks of numbers; save it again"
        )
    direct, _, (row, column), (c, d, e), (height, width) = (
        Field(numbers, document.source, "a block").array(-1) for numbers in rows[:5]
    )
    if len(direct) != direct[0] + 1 or direct[1] == 0:
        raise InputError(
            "the polynomial of OCamCalib has another number of coefficients than it says; correct it"
        )
    farthest = np.hypot(max(row, height - row), max(column, width - column))
    rho = np.linspace(0, farthest, _SAMPLES)
    theta = np.arctan2(rho, np.sign(direct[1]) * np.polynomial.polynomial.polyval(rho, direct[1:]))
    rising = np.flatnonzero(np.diff(theta) <= 0)
    theta, rho = (values[: rising[0] + 1] if len(rising) else values for values in (theta, rho))
    f, lens = fitted(theta, rho, 1.0, document, "the polynomial of OCamCalib")
    M = np.array([[1.0, e], [d, c]])  # of u, v
    turn = np.arctan2(d, c)
    A = f * M @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    if abs(turn) > _STRAIGHT:
        document.notes.append(
            f"{document.source}: the camera is turned about its axis by {np.degrees(turn):.3g} degrees from "
            "OCamCalib's, so that its rows lie along x"
        )
    K = np.array([[A[0, 0], A[0, 1], column], [0.0, A[1, 1], row], [0.0, 0.0, 1.0]])
    camera = Camera(Intrinsics.from_matrix(K), lens, (int(width), int(height)))
    return CameraSet((camera,), program="OCamCalib")


OCAM = Format(
    "OCamCalib",
    ("fisheye",),
    matches=lambda document: _MARK in document.text[:500] or re.match(r"#polynomial", document.text),
    read=_read_ocam,
    files="calib_results.txt, as the nearest fisheye",
    skew=True,
)
