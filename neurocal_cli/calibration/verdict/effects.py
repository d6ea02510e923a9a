"""What rival causes do to the pixels, and how views share it.

Effects are columns of derivatives, or steps of the camera. Patterns yield names, weights (P, V) of the views
at P places, and the number of choices. Their arguments are the linearised camera, the information (V, m, m)
of each view about the unknowns, and its right sides (V, m).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import NOTHING
from neurocal_cli.calibration.verdict.findings import DETERMINE, in_sequence
from neurocal_cli.calibration.verdict.linearised import Effect, Linearised, Seen
from neurocal_cli.calibration.verdict.rival import ABSORBED, Pattern, Steps
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.geometry import Array

BENDS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
"""Powers of x and y of a smooth bend; lower ones describe the plane."""
_GLASS = 1.5  # its refractive index
_RADIAL = (2, 3, 4)  # powers of r^2 of radial displacements, beyond those among `BENDS`
_SQUEEZED = 0.1  # least difference of the focal lengths along u and v, relative


def bends(seen: Seen) -> Array | None:
    """Heights of the board that are powers of the place on it."""
    if not seen.flat:
        return None
    x, y, _ = seen.at
    return np.stack([x**i * y**j for i, j in BENDS], axis=1)[:, :, None] * seen.by_target[:, 2:]


def stretch(seen: Seen) -> Array | None:
    """A print that is longer along the board, and whose sides lean."""
    return seen.by_target[:, :1] * np.moveaxis(seen.at[:2], 0, 1)[:, :, None] if seen.flat else None


def deformed(seen: Seen) -> Array | None:
    """A target that is not flat, deformed without a change of its scale."""
    if seen.flat:
        return None
    from neurocal_cli.adjustment.open_choices import SOLID_STRETCHES

    return np.asarray(np.einsum("kij,tipn,jtn->tkpn", SOLID_STRETCHES, seen.by_target, seen.at))


def field(seen: Seen) -> Array:
    """A smooth field of displacements, by powers of the place on the board; of that in the image if none."""
    x, y = seen.at[:2] if seen.flat else np.moveaxis(seen.pixels, 1, 0)
    return _by_powers(seen, [x**i * y**j for i, j in ((1, 0), (0, 1), *BENDS)])


def another_lens(seen: Seen) -> Array:
    """A smooth field of displacements in the image; those along the radius by higher powers as well."""
    x, y = np.moveaxis(seen.pixels, 1, 0)
    outwards = np.einsum("taip,tap->tip", seen.by_entries[:, 3:5], seen.pixels)[:, None]
    radial = [outwards * ((x**2 + y**2) ** k)[:, None, None] for k in _RADIAL]
    return np.concatenate([_by_powers(seen, [x**i * y**j for i, j in BENDS]), *radial], axis=1)


def _by_powers(seen: Seen, powers: list[Array]) -> Array:
    """Displacements along u and along v that are powers (T, n) of a place."""
    columns = np.stack(powers, axis=1)[:, :, None]
    return np.concatenate([seen.by_entries[:, 3 + a, None] * columns for a in (0, 1)], axis=1)


def glass(seen: Seen) -> Array | None:
    """A plate of glass on the board: points move away from the foot of the camera's perpendicular."""
    if not seen.flat:
        return None
    slope = seen.to_camera[:, :2] / np.abs(seen.to_camera[:, 2:])  # tangents of the angles of incidence
    s2 = (slope**2).sum(axis=1, keepdims=True)
    shift = slope * (1 / np.sqrt(_GLASS**2 * (1 + s2) - s2) - 1 / _GLASS)
    return (seen.by_target[:, :2] * shift[:, :, None]).sum(axis=1, keepdims=True)


def no_pupil(seen: Seen) -> Array:
    """Rays that meet the axis of the lens elsewhere, the more they lean."""
    r2 = ((seen.from_centre / seen.focal[:, None]) ** 2).sum(axis=1)
    by_depth = seen.by_pose[:, 5] / seen.size[:, None, None]
    return (by_depth * r2[:, None])[:, None]


def squeezed(seen: Seen) -> Array | None:
    """Distortion that is round in an image that a lens has squeezed, and not in the angles of the rays."""
    if np.ptp(seen.focal) < _SQUEEZED * seen.focal.max():
        return None
    x, y = np.moveaxis(seen.from_centre, 1, 0)[:, :, None, None]
    r2 = (x**2 + y**2)[:, :, 0]
    return (x * seen.by_entries[:, 3, None] + y * seen.by_entries[:, 4, None]) * r2[:, :, None]


def turning(seen: Seen) -> Array:
    """The camera turns while the rows are read: the image moves."""
    return seen.by_entries[:, 3:5] * seen.pixels[:, None, None, 1]


def moving(seen: Seen) -> Array | None:
    """The target moves past the camera while the rows are read; nearer points move farther."""
    if not seen.flat:
        return None
    nearer = 1 / np.linalg.norm(seen.to_camera, axis=1)
    return seen.by_entries[:, 3:5] * (seen.pixels[:, 1] * nearer / nearer.mean())[:, None, None]


def pose(seen: Seen) -> Array:
    """The pose of the view is another one."""
    return _motion(seen, seen.by_pose[:, :3])


def moved_camera(seen: Seen) -> Array:
    """The camera is elsewhere by one motion in its own frame, as if a hand-eye calibration were wrong."""
    origin = seen.origin[:, :, None, None]
    return _motion(seen, seen.by_pose[:, :3] + np.cross(origin, seen.by_pose[:, 3:], axis=1))


def _motion(seen: Seen, turned: Array) -> Array:
    """A rotation, and a shift over the size of the target."""
    return np.concatenate([turned, seen.by_pose[:, 3:] / seen.size[:, None, None, None]], axis=1)


def moved_target(seen: Seen) -> Array:
    """The target is elsewhere by one motion in its own frame."""
    turned = np.cross(np.moveaxis(seen.at, 0, 1)[:, :, None], seen.by_target, axis=1)
    return np.concatenate([turned, seen.by_target / seen.half], axis=1)


def cut(axis: int) -> Effect:
    """The farther half of the images along u or v is displaced."""
    return lambda seen: seen.by_entries[:, 3:5] * (seen.pixels[:, None, None, axis] > 0)


def blocks(side: int) -> Effect:
    """Displacements that depend on the place within blocks of this size [px]."""

    def effect(seen: Seen) -> Array:
        phase = 2 * np.pi * (seen.observed + 0.5) / side
        waves = np.stack([np.cos(phase), np.sin(phase)], axis=2)[:, :, :, None]  # (T, axis, 2, 1, n)
        return np.concatenate([seen.by_entries[:, 3 + a, None] * waves[:, a] for a in (0, 1)], axis=1)

    return effect


def focal_length(lin: Linearised) -> Array:
    """A change of the focal length, relative."""
    steps = np.zeros((lin.width, 1))
    steps[:3, 0] = lin.state.entries[0, :3]
    steps[2] *= not lin.state.square  # A11 moves A22 as well
    return steps if lin.alphas_free else steps[:, :0]


def image_size(lin: Linearised) -> Array:
    """A change of the size of the image, relative."""
    corner = lin.views.pixel_centre / lin.views.pixel_scale
    return _of_entries(lin, lin.state.entries[0] + np.append([0.0, 0.0, 0.0], corner))


def centre(lin: Linearised) -> Array:
    """A change of the image centre, over the focal length."""
    return _of_entries(lin, *(lin.state.entries[0, 0] * np.eye(5)[3:]))


def camera(lin: Linearised) -> Array:
    """A change of the focal lengths and the centre, over the focal length."""
    places = [0, 3, 4] if lin.state.square else [0, 2, 3, 4]
    return _of_entries(lin, *(lin.state.entries[0, 0] * np.eye(5)[places]))


def camera_and_lens(lin: Linearised) -> Array:
    """The same, and the coefficients of the lens."""
    steps, k = camera(lin), lin.free[(lin.free >= 5) & (lin.free < 5 + len(lin.state.k))]
    return np.concatenate([steps, np.eye(lin.width)[:, k]], axis=1) if steps.size else steps


def given(lin: Linearised) -> Array:
    """A change of the given focal lengths and centre, over the focal length."""
    places = lin.given[lin.given != 1]
    steps = np.zeros((lin.width, len(places)))
    steps[places, np.arange(len(places))] = lin.state.entries[0, 0]
    return steps


def given_scale(lin: Linearised) -> Array:
    """One change of both given focal lengths, as by another focus or image size."""
    steps = given(lin).sum(axis=1, keepdims=True)
    steps[3:] = 0.0
    return steps[:, : int({0, 2} <= set(lin.given.tolist()))]


def given_lens(lin: Linearised) -> Array:
    """A change of the given coefficients of the lens, if the focal length is given; k1 and k2 without any."""
    of_model = lin.columns["lens"][0] - 5 if lin.columns["lens"].size else len(lin.state.k)
    of_lens = np.arange(5, 5 + (of_model or min(2, len(lin.state.k))))
    places = of_lens[~np.isin(of_lens, lin.free)]  # np.setdiff1d would load numpy.ma
    return np.eye(lin.width)[:, places if 0 in lin.given else places[:0]]


def lens(model: str) -> Steps:
    """The coefficients that a model has and the chosen one of its kind, unless that is given, lacks."""
    wide, has = model in WIDE, coefficient_names(model)

    def steps(lin: Linearised) -> Array:
        names, lacking = coefficient_names(lin.state.model), lin.columns["lens"].tolist()
        alike = lin.state.distortion.wide == wide and 0 not in lin.given
        return np.eye(lin.width)[:, [k for k in lacking if alike and names[k - 5] in has] or slice(0)]

    return steps


def _of_entries(lin: Linearised, *changes: Array) -> Array:
    steps = np.zeros((lin.width, len(changes)))
    if not (lin.alphas_free and np.isin((3, 4), lin.free).all()):
        return steps[:, :0]
    steps[:5] = np.stack(changes, axis=1)
    steps[2] *= not lin.state.square  # A11 moves A22 as well
    return steps


_BY_POSE = 6.0  # ways in which poses differ, with which errors of the lens are correlated


def common(lin: Linearised, S: Array, g: Array) -> Iterator[Pattern]:
    """The same in all views."""
    yield "all", np.ones(lin.views.n_views), 1.0


def one_view(lin: Linearised, S: Array, g: Array) -> Iterator[Pattern]:
    """Each view alone."""
    V = lin.views.n_views
    if V >= DETERMINE:
        yield "one", np.eye(V), float(V)


def changing(lin: Linearised, S: Array, g: Array) -> Iterator[Pattern]:
    """Along the sequence, with the distance, with the tilt of the target, or between groups."""
    views, state = lin.views, lin.state
    if views.n_views <= DETERMINE:
        return
    yield "line", _ramp(_places(lin).astype(float)), 1.0
    distance = np.linalg.norm(state.t, axis=1) * views.scale
    yield "distance", _ramp(1.0 / distance), _BY_POSE
    if views.nearly_flat.all():
        normal = (state.R @ views.basis)[:, :, 2]
        normal = normal * -np.sign((normal * state.t).sum(axis=1, keepdims=True))
        for axis, name in enumerate("uv"):
            yield f"tilt along {name}", _ramp(normal[:, axis]), _BY_POSE
    yield from grouped(lin, S, g)


def grouped(lin: Linearised, S: Array, g: Array) -> Iterator[Pattern]:
    """From a view on, every other view, or any two groups."""
    V, place = lin.views.n_views, _places(lin)
    if V <= DETERMINE:
        return
    yield step(place)
    yield "groups", (place % 2 == 1).astype(float), 1.0
    yield "groups", step(_by_change(S, g))[1], float(2.0 ** min(V - 1, 1000))


def step(place: NDArray[np.intp]) -> Pattern:
    """From a place of the sequence on; two views or more are before it, and two after it."""
    places = np.arange(2, len(place) - 1)
    return "step", (place >= places[:, None]).astype(float), float(len(places))


def _places(lin: Linearised) -> NDArray[np.intp]:
    """(V,) place of each view in the sequence."""
    return np.argsort(in_sequence(lin.views.names))


def _ramp(values: Array) -> Array:
    return (values - values.mean()) / max(float(np.ptp(values)), NOTHING)


def _by_change(S: Array, g: Array) -> NDArray[np.intp]:
    """(V,) place of each view by the change for which it asks, along the direction in which they differ most.

    Two groups that differ lie at the two ends.
    """
    values, axes = np.linalg.eigh(S.sum(axis=0))
    whitening = axes / np.sqrt(np.maximum(values, ABSORBED * values[-1]) + NOTHING)
    asked = g @ whitening
    direction = whitening @ np.linalg.eigh(asked.T @ asked)[1][:, -1]
    change = g @ direction / np.maximum(direction @ S @ direction, NOTHING)
    return np.argsort(np.argsort(change, kind="stable"))
