"""Cameras whose formula is none of ours, as the nearest of ours: OCamCalib, WoodScape, FOV, OpenPTV.

A curve of the radius over the angle is fitted by f (theta + k1 theta^3 + ... + k4 theta^9). The largest
difference over the image is told, in pixels.

In OpenPTV, the orientation of a camera is ``.ori``, its distortion ``.addpar``, and the pixels are in
``ptv.par``. All is in mm on the sensor, from its middle, with y up and z towards the viewer; the centre of
the first pixel is (1/2, 1/2). Brown's polynomial is that of OpenCV, but about the middle of the sensor and
not about the principal point. If these differ, the camera becomes the nearest one.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.nearest_camera import fitted_to_rays
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.camera_tree import parse_tree
from neurocal_cli.files.exchange.camera_names import matrix_of
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.format_table import CameraSet, Format, Parts, PoseKeys, Tree
from neurocal_cli.files.exchange.tree_paths import in_order, in_rows
from neurocal_cli.files.reading import read_text
from neurocal_cli.files.tree_fields import Field

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
    document.doubt(f"{model} is no model here; the nearest fisheye moves pixels by {error:.2g} px at most")
    return float(c[0]), Distortion("fisheye", c[1:] / c[0])


def with_fov(found: CameraSet, parts: Parts, document: Document) -> CameraSet:
    """The camera, if its lens is FOV that of Devernay and Faugeras (2001).

    r = atan(2 tan(theta) tan(omega / 2)) / omega.
    """
    tree, camera = parts["camera"].value, found.cameras[0]
    omega = tree["D"][0] if tree["model"] == "FOV" else 0.0
    if abs(omega) < _STRAIGHT:
        return found
    fx, _, fy, u0, v0 = camera.entries
    width, height = camera.image_size or (2 * u0, 2 * v0)
    corner = np.hypot(max(u0, width - u0) / fx, max(v0, height - v0) / fy)
    radius = np.linspace(0, min(corner, 0.99 * np.pi / 2 / omega), _SAMPLES)
    theta = np.arctan2(np.sin(radius * omega), 2 * np.tan(omega / 2) * np.cos(radius * omega))
    f, lens = fitted(theta, radius, max(fx, fy), document, f"the FOV model with omega = {omega:g}")
    A = Intrinsics(f * fx, f * fy, u0, v0)
    return replace(found, cameras=(replace(camera, intrinsics=A, distortion=lens),))


# OCamCalib (Scaramuzza 2006). A pixel is [row, column] = [[c, d], [e, 1]] rho (x, y) / |(x, y)| + centre,
# with x down and y right, and the ray (x, y, f(rho)) has z backwards.
_MARK = re.compile(r"#polynomial|.{,500}polynomial coefficients for the DIRECT mapping", re.DOTALL).match


def _ocam_parts(document: Document) -> dict[str, Tree]:
    order = "direct:,inverse:,row column,c d e,height width"
    if (found := in_rows(order, document.text, document.source)) is None:
        raise InputError(
            "is a damaged file of OCamCalib: it has not all its blocks of numbers; save it again"
        )
    direct, _, row, column, c, d, e, height, width = found.value.values()
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
        document.note(
            f"the camera is turned about its axis by {np.degrees(turn):.3g} degrees from "
            "OCamCalib's, so that its rows lie along x"
        )
    K = matrix_of(A[0, 0], A[1, 1], column, row, A[0, 1])
    return {"camera": {"K": K.tolist(), "k": lens.coefficients.tolist(), "size": [width, height]}}


OCAM = Format(
    "OCamCalib",
    "K",
    "fisheye k",
    size="size",
    told=lambda document: _MARK(document.text[:600]),
    files="calib_results.txt, as the nearest fisheye",
    parts=_ocam_parts,
    has_skew=True,
)


# WoodScape: the radius [px] is a polynomial of the angle [rad], about a point from the middle of the image.
# The pose is that of the camera in the vehicle, its quaternion x, y, z, w.
_WOODSCAPE = ("k1", "k2", "k3", "k4", "cx_offset", "cy_offset", "width", "height")


def _woodscape(document: Document) -> dict[str, Tree]:
    stated = document.tree.get("intrinsic")
    told = isinstance(stated, dict) and {*_WOODSCAPE} <= set(stated) and stated.get("model") == "radial_poly"
    if not told:
        return {}
    own = document.root["intrinsic"]
    *k, u0, v0, _, _ = (own[key].number() for key in _WOODSCAPE)
    width, height = own["width"].integer(1), own["height"].integer(1)
    u0, v0 = u0 + 0.5 * (width - 1), v0 + 0.5 * (height - 1)
    aspect = own.get("aspect_ratio", 1.0).number()
    far = np.hypot(max(u0, width - u0), max(v0, height - v0) / aspect)
    theta = np.linspace(0, np.pi, 4 * _SAMPLES)
    radius = np.polynomial.polynomial.polyval(theta, np.array([0.0, *k]))
    end = int(np.argmax((radius > far) | (np.gradient(radius) <= 0))) or len(theta)
    f, lens = fitted(theta[:end], radius[:end], 1.0, document, "the polynomial of WoodScape")
    K, size = matrix_of(f, f * aspect, u0, v0).tolist(), [width, height]
    return {"camera": {**document.tree, "K": K, "k": lens.coefficients.tolist(), "size": size}}


WOODSCAPE = Format(
    "WoodScape",
    "K",
    "fisheye k",
    size="size",
    name="name",
    told=_woodscape,
    files="calibration of WoodScape, JSON, as the nearest fisheye",
    pose=PoseKeys("extrinsic/quaternion/3,0,1,2 extrinsic/translation", back=True, frame="vehicle"),
    unit="m",
)

ORIENTATION = "place:3,angles:3,R:9/3,centre:2,f,glass:3"  # the rows of a .ori of OpenPTV
LENS = "k1 k2 k3 p1 p2 scale shear"  # that of its .addpar
_FLIP = np.diag([1.0, -1.0, -1.0])
_GRID = 15  # rays along each side of the image
_PIXELS = ("imx", "imy", "pix_x", "pix_y", "mmp_n1", "mmp_n2", "mmp_n3")
_PAR = ("ptv.par", "../parameters/ptv.par", "parameters/ptv.par", "../ptv.par")


def _pixels(path: Path) -> tuple[list[float], bool]:
    """Width and height [px], the sides of a pixel [mm], and whether rays are broken at glass."""
    folder = path.parent
    runs = sorted([*folder.glob("parameters*.yaml"), *folder.parent.glob("parameters*.yaml")])  # of pyptv
    par = next((folder / place for place in _PAR if (folder / place).exists()), None)
    found = {tuple(_of_run(run)) for run in runs} if par is None else {tuple(_of_par(par))}
    if not found:
        raise InputError(
            "is an orientation of OpenPTV, in mm of the sensor; put ptv.par, which has the size of the "
            f"pixels, beside it, or give it in its folder cal beside {_PAR[1][3:]} or parameters_Run1.yaml"
        )
    if len(found) > 1:
        raise InputError(
            f"{', '.join(run.name for run in runs)} differ in the pixels; leave the right one there"
        )
    (values,) = found
    if min(values[:4]) <= 0 or any(side % 1 for side in values[:2]):
        raise FormatError("the size of the images or of the pixels is none; correct it", str(par or runs[0]))
    return list(values[:4]), len(set(values[4:])) > 1


def _of_par(place: Path) -> list[float]:
    """Width, height, sides of a pixel and three refractive indices of ``ptv.par``."""
    text, source = read_text(place)
    words = text.split()
    rest = words[1 + 2 * int(words[0]) :] if words and words[0].isdecimal() else []
    values: list[float] = Field(rest[3:11], source, "the lines from imx on").array(8).tolist()
    return values[:4] + values[5:]


def _of_run(place: Path) -> list[float]:
    """The same of a run of pyptv."""
    ptv = parse_tree(*read_text(place))["ptv"]
    return [ptv[name].number() for name in _PIXELS]


def _openptv(document: Document) -> dict[str, Tree]:
    if (own := in_rows(ORIENTATION, document.text, document.source)) is None:
        return {}
    path = Path(document.source)
    pixels, broken = _pixels(path)
    lens = path.with_suffix(".addpar")
    k = Field({**dict.fromkeys(LENS.split(), 0.0), "scale": 1.0}, document.source)
    if lens.exists():
        text, source = read_text(lens)
        k = in_order(LENS, text.split(), source)
    else:
        document.doubt(f"there is no {lens.name}, so it has no distortion")
    camera = _camera(own, k, pixels, document)
    R = _FLIP @ own["R"].array(9).reshape(3, 3).T
    pose = {"R": R.tolist(), "t": (-R @ own["place"].array(3)).tolist()}
    if broken:
        document.note("rays are broken at glass, so its pose is left out")
    tree = {"K": camera.A.tolist(), "D": camera.distortion.coefficients.tolist() or [0.0], "size": pixels[:2]}
    return {path.name.split(".")[0]: {**tree, **({} if broken else pose)}}


def _camera(own: Field, lens: Field, pixels: list[float], document: Document) -> Camera:
    """The camera of an orientation and its distortion, or the nearest one."""
    centre, f = own["centre"].array(2), own["f"].number()
    k1, k2, k3, p1, p2, scale, shear = (lens[key].number() for key in LENS.split())
    size, side = np.array(pixels[:2]), np.array(pixels[2:])
    affine = np.array([[scale, np.sin(shear)], [0.0, np.cos(shear)]]) / side[:, None]
    middle = 0.5 * size
    origin = centre * [1, -1]  # y down

    start = np.array([*(f * affine).ravel()[[0, 1, 3]], *(affine @ origin + middle)])
    k = np.array([k1 * f**2, k2 * f**4, -p2 * f, p1 * f, k3 * f**6])
    a, skew, b, u0, v0 = start
    A = Intrinsics.from_matrix(matrix_of(a, b, u0, v0, skew))
    exact = Camera(A, Distortion("plumb_bob", k) if k.any() else Distortion(), (int(size[0]), int(size[1])))
    if not (k.any() and origin.any()):
        return exact
    # Pixels of rays by OpenPTV's formula, and the camera of OpenCV's that is nearest to them.
    corner = np.abs(np.linalg.inv(affine)) @ (0.5 * size)
    grid = np.stack(np.meshgrid(*(np.linspace(-c, c, _GRID) for c in corner)), axis=-1).reshape(-1, 2)
    x, y = grid.T
    r = x**2 + y**2
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
    bent = [
        x * radial + p1 * (r + 2 * x**2) - 2 * p2 * x * y,
        y * radial - p2 * (r + 2 * y**2) + 2 * p1 * x * y,
    ]
    there = np.array(bent).T @ affine.T + middle
    rays = np.column_stack([(grid - origin) / f, np.ones(len(grid))])

    found = fitted_to_rays(exact, "plumb_bob", np.array([*start, *k]), True, rays, there)
    near = exact if found is None else found[0]
    worst = float(np.hypot(*(near.project(rays)[0] - there).T).max())
    if worst > _WORST:
        raise InputError(
            f"no camera of OpenCV's is within {_WORST:g} px of this one; calibrate from its points"
        )
    document.doubt(
        f"OpenPTV's distortion is about the middle of the sensor; the nearest camera "
        f"about the principal point moves pixels by {worst:.2g} px at most"
    )
    return near


OPENPTV = Format(
    "OpenPTV",
    "K",
    "plumb_bob D",
    size="size",
    told=_openptv,
    files=".ori with its .addpar; ptv.par beside it or in ../parameters, or a run of pyptv",
    pose=PoseKeys("R t", frame="world"),
    unit="mm",
    has_skew=True,
    first_pixel=0.5,
)
