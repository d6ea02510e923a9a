"""A calibration problem: the points, and the given parameters of the camera (the paper's section 4.1).

Given are: type 1: nothing. Type 2: the image centre, W13 and W23. Type 3: the intrinsics, all of W.
Type 4: the extrinsics, V. Adjustments work in normalised units; `in_pixels` and `normalised` convert states.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import field, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import OPTIONS, Adjusted, Penalty, adjust
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses
from neurocal_cli.adjustment.views import Views, arrange
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import Distortion, coefficient_names, pinhole_coefficients
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, rotation_to_axis
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, Intrinsics, Pose
from neurocal_cli.camera.projection import ENTRIES, ENTRY_NAMES, image_points
from neurocal_cli.camera.rich_lens import FIRST_NODE
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import InputError, UsageError
from neurocal_cli.observations.points import Correspondences

_LEAST_DEPTH = 0.1  # smallest depth of a unit ray: 84 degrees from the view's mean direction
_LARGEST = 1e9  # px; no image is larger
# Noise puts pixels at most this share of their distance from the centre beyond the lens's domain.
_RIM, _HALVINGS = 0.02, 30
_SINGLE = ("alpha_u", "alpha_v", "u0", "v0")  # those that can be fixed one by one
_HOLDING = ("k1", "k1k2", "k1k2p1p2", "plumb_bob", "fisheye")  # models whose coefficients can be fixed


@frozen_dataclass(eq=False)
class Problem:
    """Which parameters are estimated from which points."""

    points: Correspondences
    # The same points, normalised. A given distortion is removed from their pixels, because the networks model
    # a pinhole; `with_seen_pixels` restores it.
    views: Views
    type: int
    entries: Array  # (5,) A11, A12, A22, A13, A23 [px]; only the given ones are meaningful
    free: NDArray[np.bool_]  # (5,) entries to estimate
    poses: Mapping[str, Pose] | None  # the given poses by view
    # Names of the given intrinsic parameters, and of distortion coefficients that stay as they are.
    fixed: frozenset[str]
    intrinsics: Intrinsics | None  # the given intrinsics of type 3, returned unchanged
    distortion: Distortion  # the final distortion model, with its coefficients if they are given
    free_distortion: bool  # whether the coefficients that are not fixed are estimated
    # Extra residuals on the distortion: a condition that holds for these points only, or a rich lens's prior,
    # which holds for any points.
    penalty: Penalty | None = None
    # Values of the distortion coefficients that are given one by one.
    held: Mapping[str, float] = field(default_factory=dict)
    # Whether the pixels are square: A22 follows A11.
    square: bool = False
    # If a given wide lens is removed, each view has a pinhole that looks at its target: rotations (V, 3, 3)
    # from the camera's frame to that pinhole's. None after `with_seen_pixels`.
    turned: Array | None = None

    @property
    def free_camera(self) -> NDArray[np.bool_]:
        """(5 + K,) which of A's entries and of the distortion coefficients are unknowns."""
        coefficients = [
            self.free_distortion and name not in self.fixed
            for name in coefficient_names(self.distortion.model)
        ]
        free = np.concatenate([self.free, np.array(coefficients, dtype=bool)])
        free[2] &= not self.square
        return free

    def free_with(self, model: str) -> NDArray[np.bool_]:
        """`free_camera` of a state with this model: the problem's, or none before its coefficients exist."""
        return self.free_camera if model == self.distortion.model else self.free_camera[:5]

    @property
    def free_of_prior(self) -> NDArray[np.bool_]:
        """`free_camera` without the nodes of a rich lens, which its prior determines where points do not."""
        free = self.free_camera
        if self.distortion.model == "rich":
            free[5 + FIRST_NODE :] = False
        return free

    @property
    def free_poses(self) -> bool:
        """Whether the poses are estimated."""
        return self.poses is None

    @property
    def n_parameters(self) -> int:
        """Number of unknowns that the points must determine without a prior."""
        return int(self.free_of_prior.sum()) + (6 * self.views.n_views if self.free_poses else 0)

    @property
    def given_centre(self) -> Array | None:
        """(2,) the image centre [px] if it is given, else None."""
        return None if self.free[3:].any() else self.entries[3:]

    @property
    def normalised_entries(self) -> Array:
        """The given entries in normalised pixels, ``S1^-1 A``; (5,). The free ones are meaningless."""
        scaled = self.entries.copy()
        scaled[3:] -= self.views.pixel_centre
        return scaled / self.views.pixel_scale

    def matrix(self, entries: Array) -> Array:
        """A [px] from normalised entries; given entries come back exactly as given."""
        pixels = entries * self.views.pixel_scale
        pixels[3:] += self.views.pixel_centre
        return intrinsic_matrix(np.where(self.free, pixels, self.entries))

    def with_points(self, points: Correspondences) -> Problem:
        """The same problem with other points.

        Raises InputError if the given distortion maps no ray to one of the pixels, and
        DegenerateGeometryError if all pixels coincide.
        """
        views, turned = _views_of(points, self.distortion, self.entries, self.free_distortion)
        penalty = self.penalty if self.distortion.model == "rich" else None
        return replace(self, points=points, views=views, turned=turned, penalty=penalty)

    def with_model(self, model: str) -> Problem:
        """The same points with another distortion model to estimate."""
        # Fixed coefficients belong to the previous model.
        held = self.held if model == self.distortion.model else {}
        fixed = self.fixed & {*INTRINSIC_NAMES, *held}
        return replace(
            self, distortion=Distortion(model), free_distortion=model != "none", fixed=fixed, penalty=None,
            held=held,
        )  # fmt: skip

    def with_seen_pixels(self) -> Problem:
        """The same problem with the observed (distorted) pixels, normalised as before."""
        views = self.views
        order = slice(None) if views.order is None else views.order
        pixels = (self.points.pixels[order] - views.pixel_centre) / views.pixel_scale
        return replace(self, views=replace(views, pixels=pixels), turned=None)

    def as_seen(self, state: CameraState) -> tuple[Problem, CameraState]:
        """Undo the removal of a given distortion, if there is one: with observed pixels, and their state."""
        if self.distortion.model == "none" or self.free_distortion:
            return self, state
        state = replace(state, model=self.distortion.model, k=self.distortion.coefficients)
        if self.turned is not None:
            back = np.swapaxes(self.turned, 1, 2)
            state = replace(state, R=back @ state.R, t=(back @ state.t[..., None])[..., 0])
        return self.with_seen_pixels(), state

    def minimum(self, adjusted: Adjusted, repeated: RepeatedPoses | None = None) -> Minimum:
        """The linearised camera at a minimum; for `repeated` see there."""
        free = self.free_with(adjusted.state.model)
        return Minimum(self.views, adjusted.state, adjusted.normal, free, self.free_poses, repeated)

    def adjust(
        self,
        start: CameraState | Adjusted,
        max_iterations: int = OPTIONS.max_iterations,
        damping: float = OPTIONS.damping,
    ) -> Adjusted:
        """Minimise the reprojection error (3) from a state; see `adjust`.

        If the distortion is estimated and the start is a pinhole, its coefficients start at those of a
        pinhole. If the start is itself an adjustment, its iterations are added.
        """
        done = start.iterations if isinstance(start, Adjusted) else 0
        state = start.state if isinstance(start, Adjusted) else start
        if self.free_distortion and state.model == "none":
            model = self.distortion.model
            state = replace(state, model=model, k=pinhole_coefficients(model))
        if not self.free[[0, 2]].all() and self.type != 3:  # another model may have begun with another alpha
            entries = np.where(self.free, state.entries, self.normalised_entries)
            state = replace(state, entries=entries)
        if self.held and state.model == self.distortion.model:
            names = coefficient_names(state.model)
            k = [self.held.get(name, value) for name, value in zip(names, state.k.tolist(), strict=True)]
            state = replace(state, k=np.array(k))
        if self.square:
            mean = np.sqrt(state.entries[:, :1] * state.entries[:, 2:3])
            state = replace(state, square=True).with_entries(np.hstack([mean, state.entries[:, 1:]]))
        adjusted = adjust(
            self.views.batches,
            state,
            self.free_with(state.model),
            self.free_poses,
            max_iterations,
            self.penalty,
            damping,
        )
        return replace(adjusted, iterations=done + adjusted.iterations)


def problem_for(
    points: Correspondences,
    type: int,
    image_center: tuple[float, float] | None = None,
    intrinsics: Intrinsics | None = None,
    extrinsics: Mapping[str, Pose] | None = None,
    skew: bool = True,
    distortion: Distortion | None = None,
    fix: Mapping[str, float] | None = None,
    square: bool = False,
) -> Problem:
    """State a problem; check that the given parameters are those of its type.

    `image_center`, `intrinsics`, `extrinsics`, `skew`, `fix` and `square` (its `square_pixels`) are as for
    `calibrate`. `distortion` is the given one with type 3, else the model to be estimated.

    Raises UsageError if the type does not exist, a parameter that it needs is missing, or one that it does
    not use is given. Raises InputError if there are no points, a value is not finite, the extrinsics lack a
    view, or the given distortion maps no ray to a pixel. Raises DegenerateGeometryError if all pixels
    coincide.
    """
    _check_given(
        points, type, {"image_center": image_center, "intrinsics": intrinsics, "extrinsics": extrinsics}
    )
    distortion = distortion or Distortion()
    given: dict[str, float] = {} if skew else {"theta": 0.0}  # A's entries by their parameters
    if type == 2:
        given |= zip(("u0", "v0"), _centre(points, image_center).tolist(), strict=True)
    elif type == 3:
        given = _entries_of(intrinsics)
    poses = _poses(points, extrinsics) if type == 4 else None
    if square:
        fix = _both_alphas(fix or {}, type, skew)
    held: dict[str, float] = {}
    for name, number in (fix or {}).items():
        _check_fixed(name, number, given, type, skew, distortion.model)
        (given if name in ENTRY_NAMES else held)[name] = float(number)
    known = coefficient_names(distortion.model) if type == 3 else held
    entries = np.array([given.get(name, 0.0) for name in ENTRY_NAMES])
    free_distortion = type != 3 and distortion.model != "none"
    views, turned = _views_of(points, distortion, entries, free_distortion)
    free = np.array([name not in given for name in ENTRY_NAMES])
    fixed, tied = frozenset((*given, *known)), square and "alpha_u" not in given
    return Problem(
        points, views, type, entries, free, poses, fixed, intrinsics, distortion, free_distortion,
        held=held, square=tied, turned=turned,
    )  # fmt: skip


def _check_given(points: Correspondences, type: int, given: Mapping[str, object]) -> None:
    """Refuse a type that does not exist, no points, and what a type does not use; `given` are for 2, 3, 4."""
    if not isinstance(type, (int, np.integer)) or type not in (1, 2, 3, 4):
        raise UsageError(f"type must be 1, 2, 3 or 4, not {type!r}")
    if not len(points):
        raise InputError(f"{points.source}: there are no points to calibrate from; give some")
    for wanted, (name, value) in enumerate(given.items(), start=2):
        if value is not None and type != wanted:
            raise UsageError(f"{name} needs type {wanted}, but the type is {type}; give type={wanted}")


def _entries_of(intrinsics: Intrinsics | None) -> dict[str, float]:
    """A's entries of type 3."""
    if intrinsics is None:
        raise UsageError("type 3 needs the intrinsics of the camera; give intrinsics=")
    entries = intrinsics.A[ENTRIES]
    if not np.abs(entries[[0, 2]]).min() > 1 / _LARGEST or np.abs(entries).max() > _LARGEST:
        raise InputError(
            "the given intrinsics are out of range: alpha and the centre must be of the size of an "
            "image; correct them"
        )
    return dict(zip(ENTRY_NAMES, entries.tolist(), strict=True))


def _both_alphas(fix: Mapping[str, float], type: int, skew: bool) -> Mapping[str, float]:
    """The given parameters of a camera with square pixels: if one alpha is among them, so is the other."""
    if type == 3:
        raise UsageError("type 3 does not change the given camera; leave out square_pixels")
    if skew:
        raise UsageError("square pixels have right angles; give skew=False (--skew fixed) as well")
    alphas = {float(fix[name]) for name in ("alpha_u", "alpha_v") if name in fix}
    if len(alphas) > 1:
        raise UsageError("square pixels have equal alphas, but alpha_u and alpha_v are fixed at two values")
    return {**fix, **dict.fromkeys(("alpha_u", "alpha_v") if alphas else (), *alphas)}


def _check_fixed(name: str, value: float, fixed: Collection[str], type: int, skew: bool, model: str) -> None:
    """Refuse a parameter that cannot be given by itself."""
    if name == "theta":
        raise UsageError("theta is fixed at a right angle only; give skew=False (--skew fixed) for it")
    if name in fixed or type == 3:
        raise UsageError(f"type {type} gives {name} already; leave out one of them")
    if name == "alpha_v" and skew:
        raise UsageError(
            "alpha_v can be fixed with right angles only; give skew=False (--skew fixed) as well"
        )
    if name.startswith("alpha") and model in WIDE and model != "fisheye":
        raise UsageError(
            f"{name} cannot be fixed with the distortion model {model}, which scales it by other parameters; "
            "name fisheye or a model for ordinary lenses"
        )
    if name not in _SINGLE and not (model in _HOLDING and name in coefficient_names(model)):
        models = [one for one in _HOLDING if name in coefficient_names(one)]
        told = f"it is a coefficient of {', '.join(models)}; name one of these distortion models"
        raise UsageError(f"{name} cannot be fixed: {told if models else 'give one of ' + ', '.join(_SINGLE)}")
    least = 1 / _LARGEST if name.startswith("alpha") else -_LARGEST
    if (
        isinstance(value, bool)
        or not isinstance(value, (int, float, np.number))
        or not least < value < _LARGEST
    ):
        raise InputError(f"{name} is fixed at {value!r}, which no camera has; correct it")


def _centre(points: Correspondences, image_center: tuple[float, float] | None) -> Array:
    centre = image_center if image_center is not None else points.assumed_centre
    if centre is None:
        raise UsageError("type 2 needs the image centre; give it, or put image_center into the points file")
    try:
        values = np.array(centre, dtype=float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (2,) or not (np.abs(values) < _LARGEST).all():  # False for nan as well
        raise InputError("the image centre must be two finite numbers of the size of an image; correct it")
    return values


def _poses(points: Correspondences, extrinsics: Mapping[str, Pose] | None) -> dict[str, Pose]:
    if extrinsics is None:
        raise UsageError("type 4 needs the extrinsics of each view; give extrinsics=")
    missing = [name for name in points.view_names if name not in extrinsics]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise InputError(
            f"the extrinsics have no view named {missing[0]!r}{more}; they have "
            f"{', '.join(repr(name) for name in list(extrinsics)[:5]) or 'none'}"
        )
    return {name: extrinsics[name] for name in points.view_names}


def _views_of(
    points: Correspondences, distortion: Distortion, entries: Array, free_distortion: bool
) -> tuple[Views, Array | None]:
    """Views with a given distortion removed from their pixels, and the rotations of their pinholes."""
    if free_distortion or distortion.is_identity:
        return arrange(points), None
    camera = Camera(Intrinsics.from_matrix(intrinsic_matrix(entries)), distortion)
    seen = _seen_nearby(camera, points.pixels)
    rays = camera.unproject(seen)
    lost = ~np.isfinite(rays[:, 0])
    if lost.any():
        row = int(np.argmax(lost))
        u, v = points.pixels[row]
        raise InputError(
            f"{points.place(row)}: the given distortion maps nothing to the pixel ({u:g}, {v:g}); "
            "check that the camera belongs to these images"
        )
    if not distortion.wide:
        straight = image_points(camera.entries, "none", (), *camera.normalised_points(*seen.T))
        return arrange(replace(points, pixels=np.column_stack(straight))), None
    pixels, turned = _turned_pixels(points, rays, camera)
    behind = ~np.isfinite(pixels[:, 0])
    if behind.any():
        row = int(np.argmax(behind))
        raise InputError(
            f"{points.place(row)}: this point is seen more than 84 degrees from the middle of the points in "
            "its view; leave such points out"
        )
    return arrange(replace(points, pixels=pixels)), turned


def _seen_nearby(camera: Camera, pixels: Array) -> Array:
    """The pixels; those just outside the lens's domain (by noise) are moved to its rim, others are nan."""
    outside = np.flatnonzero(~np.isfinite(camera.unproject(pixels)[:, 0]))
    if not outside.size:
        return pixels
    centre = np.array([camera.intrinsics.u0, camera.intrinsics.v0])
    low, high = np.full(outside.size, 1 - _RIM), np.ones(outside.size)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        at = centre + middle[:, None] * (pixels[outside] - centre)
        sees = np.isfinite(camera.unproject(at)[:, 0])
        low, high = np.where(sees, middle, low), np.where(sees, high, middle)
    moved = pixels.copy()
    moved[outside] = centre + low[:, None] * (pixels[outside] - centre)
    moved[outside[low == 1 - _RIM]] = np.nan
    return moved


def _turned_pixels(points: Correspondences, rays: Array, camera: Camera) -> tuple[Array, Array]:
    """Pixels (N, 2) of pinholes that look along the mean ray of each view, and their rotations (V, 3, 3).

    A target may lie more than 90 degrees from the camera's axis, but it spans a cone of less than that.
    """
    index = points.view_index
    sums = np.zeros((points.n_views, 3))
    np.add.at(sums, index, np.nan_to_num(rays))
    forward = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300)
    forward[~sums.any(axis=1)] = 0.0, 0.0, 1.0
    turned = rotation_to_axis(forward)
    X, Y, Z = (turned[index] @ rays[..., None])[..., 0].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(Z > _LEAST_DEPTH, Z, np.nan)
        return np.column_stack(image_points(camera.entries, "none", (), X / depth, Y / depth)), turned


def intrinsic_matrix(entries: Array) -> Array:
    """(3, 3) upper triangular A from its entries (5,), in any unit."""
    A = np.eye(3)
    A[ENTRIES] = entries
    return A


def in_pixels(problem: Problem, state: CameraState) -> CameraState:
    """Convert a normalised state to pixels and world units; given entries come back exactly as given."""
    entries = problem.matrix(state.entries[0])[ENTRIES]
    return replace(state, entries=entries[None], t=translations(problem.views, state))


def normalised(state: CameraState, views: Views) -> CameraState:
    """Convert a state to the normalised units of `views`; its poses are those of `views`, in their order."""
    entries = state.entries.copy()
    entries[:, 3:] -= views.pixel_centre
    t = translations_normalised(views, state.R, state.t)
    return replace(state, entries=entries / views.pixel_scale, t=t)


def translations(views: Views, state: CameraState) -> Array:
    """(V, 3) t in world units, from the normalised t, which refers to each view's centroid."""
    return state.t * views.scale[:, None] - (state.R @ views.centre[..., None])[..., 0]


def translations_normalised(views: Views, R: Array, t: Array) -> Array:
    """(V, 3) t of each view's centroid in units of its S2, from t in world units."""
    return np.asarray(((R @ views.centre[..., None])[..., 0] + t) / views.scale[:, None])
