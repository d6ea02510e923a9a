"""The four calibration problems of the paper's section 4.1: which weights are given.

Type 1: none. Type 2: the image centre, W13 and W23. Type 3: the intrinsics, all of W.
Type 4: the extrinsics, V.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.reprojection import ENTRIES
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.distortion import Distortion, coefficient_names
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, Intrinsics, Pose
from neurocal_cli.errors import InputError, UsageError
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences

__all__ = ["Known", "intrinsic_matrix", "known_for"]


_LARGEST = 1e9  # px; no image is larger


@dataclass(frozen=True, eq=False)
class Known:
    """What is given.

    Attributes
    ----------
    type : int
    entries : (5,) array
        A11, A12, A22, A13, A23 [px]; only the given ones mean something.
    free : (5,) bool array
        Entries to estimate.
    poses : dict of Pose by view, or None
    fixed : frozenset of str
        Names of the given intrinsic parameters, and of coefficients of the lens that stay as they are.
    intrinsics : Intrinsics or None
        All of them, for type 3: returned as they are.
    lens : Distortion
        The model to end with; its coefficients where they are given.
    free_lens : bool
        Whether the other coefficients are estimated.
    """

    type: int
    entries: Array
    free: NDArray[np.bool_]
    poses: Mapping[str, Pose] | None
    fixed: frozenset[str]
    intrinsics: Intrinsics | None
    lens: Distortion = field(default_factory=Distortion)
    free_lens: bool = False

    @property
    def free_camera(self) -> NDArray[np.bool_]:
        """(5 + K,) which of A's entries and of the lens's coefficients are estimated."""
        coefficients = [
            self.free_lens and name not in self.fixed for name in coefficient_names(self.lens.model)
        ]
        return np.concatenate([self.free, np.array(coefficients, dtype=bool)])

    @property
    def given_centre(self) -> Array | None:
        """(2,) the image centre [px], where it is given."""
        return None if self.free[3] else self.entries[3:]

    @property
    def free_poses(self) -> bool:
        """Whether the poses are estimated."""
        return self.poses is None

    def normalised_entries(self, views: Views) -> Array:
        """The given entries in normalised pixels, ``S1^-1 A``; (5,)."""
        scaled = self.entries.copy()
        scaled[3:] -= views.pixel_centre
        return scaled / views.pixel_scale

    def matrix(self, entries: Array, views: Views) -> Array:
        """A [px] from normalised entries; given entries come back exactly as given."""
        pixels = entries * views.pixel_scale
        pixels[3:] += views.pixel_centre
        return intrinsic_matrix(np.where(self.free, pixels, self.entries))


def intrinsic_matrix(entries: Array) -> Array:
    """(3, 3) upper triangular A from its entries (5,), in any unit."""
    A = np.eye(3)
    A[ENTRIES] = entries
    return A


def known_for(
    points: Correspondences,
    type: int,
    image_center: tuple[float, float] | None,
    intrinsics: Intrinsics | None,
    extrinsics: Mapping[str, Pose] | None,
    skew: bool,
) -> Known:
    """Check what is given against what the problem type needs.

    Raises
    ------
    UsageError
        A type that does not exist, something missing for the type, or given but of no use to it.
    InputError
        Values that are not finite, extrinsics without one of the views.
    """
    if not isinstance(type, (int, np.integer)) or type not in (1, 2, 3, 4):
        raise UsageError(f"type must be 1, 2, 3 or 4, not {type!r}")
    for name, value, wanted in (
        ("image_center", image_center, 2),
        ("intrinsics", intrinsics, 3),
        ("extrinsics", extrinsics, 4),
    ):
        if value is not None and type != wanted:
            raise UsageError(f"{name} belongs to type {wanted}, not to type {type}; give type={wanted}")
    entries, free = np.zeros(5), np.ones(5, dtype=bool)
    fixed: set[str] = set()
    poses: dict[str, Pose] | None = None
    if not skew:
        free[1] = False
        fixed.add("theta")
    if type == 2:
        entries[3:] = _centre(points, image_center)
        free[3:] = False
        fixed |= {"u0", "v0"}
    elif type == 3:
        if intrinsics is None:
            raise UsageError("type 3 needs the intrinsics of the camera")
        entries = intrinsics.A[ENTRIES]
        if not np.abs(entries[[0, 2]]).min() > 1 / _LARGEST or np.abs(entries).max() > _LARGEST:
            raise InputError(
                "the given intrinsics are no camera's: alpha and the centre must be of an image's size"
            )
        free[:] = False
        fixed = set(INTRINSIC_NAMES)
    elif type == 4:
        poses = _poses(points, extrinsics)
    return Known(type, entries, free, poses, frozenset(fixed), intrinsics)


def _centre(points: Correspondences, image_center: tuple[float, float] | None) -> Array:
    centre = image_center if image_center is not None else points.image_center
    if centre is None and points.image_size is not None:
        # The first pixel's centre is 0, the last one's is the size less 1.
        centre = ((points.image_size[0] - 1) / 2, (points.image_size[1] - 1) / 2)
    if centre is None:
        raise UsageError("type 2 needs the image centre; give it, or put image_center into the points file")
    try:
        values = np.array(centre, dtype=float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (2,) or not (np.abs(values) < _LARGEST).all():  # False for nan as well
        raise InputError("the image centre must be two finite numbers of an image's size")
    return values


def _poses(points: Correspondences, extrinsics: Mapping[str, Pose] | None) -> dict[str, Pose]:
    if extrinsics is None:
        raise UsageError("type 4 needs the extrinsics of each view")
    missing = [name for name in points.view_names if name not in extrinsics]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise InputError(
            f"the extrinsics have no view named {missing[0]!r}{more}; they have "
            f"{', '.join(repr(name) for name in list(extrinsics)[:5]) or 'none'}"
        )
    if not all(isinstance(extrinsics[name], Pose) for name in points.view_names):
        raise UsageError("the extrinsics must be a dict with a Pose for each view")
    return {name: extrinsics[name] for name in points.view_names}
