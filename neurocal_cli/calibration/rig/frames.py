"""The frames of a rig: which views of which cameras were taken at one moment.

Views of one name are one frame. If no two cameras have a name in common, names are compared without the name
of the camera, and without words such as ``cam0`` or ``left`` (``cam2_017`` and ``cam3_017`` are one frame).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.rig.pairing import ViewPairs, pair_points, pair_views
from neurocal_cli.calibration.verdict.findings import name_some
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import planes_are_named
from neurocal_cli.observations.labels import first_moved
from neurocal_cli.observations.points import Correspondences

_ANY_CAMERA = r"cam(?:era)?[ _-]?[0-9]+(?![0-9])|left|right"


@frozen_dataclass(eq=False)
class FrameNames:
    """The frames of the views of several cameras."""

    names: tuple[str, ...]  # of the frames, in the order in which the cameras saw them
    of_views: tuple[NDArray[np.intp], ...]  # of each camera, (V_c,) frame of each view

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(C, V) which camera saw which frame."""
        seen = np.zeros((len(self.of_views), len(self.names)), dtype=bool)
        for camera, frames in zip(seen, self.of_views, strict=True):
            camera[frames] = True
        return seen


def match_views(views: Mapping[str, Sequence[str]]) -> FrameNames:
    """Find the views of each camera, by its name, that belong to one frame.

    Raises InputError if two views of one camera would belong to one frame.
    """
    keys = [list(names) for names in views.values()]
    once = [name for own in keys for name in own]
    if len(set(once)) == len(once) and len(keys) > 1:
        keys = [_without_camera(camera, names) for camera, names in views.items()]
    place: dict[str, int] = {}
    frames = []
    for own in keys:
        frames.append(np.array([place.setdefault(key, len(place)) for key in own], dtype=np.intp))
    return FrameNames(tuple(place), tuple(frames))


def connected_frames(points: Mapping[str, Correspondences]) -> FrameNames:
    """The frames of all views of cameras by name; those of two cameras are paired as by `pair_views`.

    Raises InputError if they do not connect all cameras, or if the cameras do not see one target.
    """
    if len(points) > 2:
        check_one_target(points)
        views = match_views({name: one.view_names for name, one in points.items()})
        seen = views.seen.astype(int)
        together = seen[:, seen.sum(axis=0) > 1]
        refuse_apart(list(points), together @ together.T > 0)
        return views
    left, right = points.values()
    pairs = pair_views(left.view_names, right.view_names)
    if _of_other_planes(left, right, pairs):
        check_one_target(points)
    else:
        pair_points(left, right, pairs)
    partner = {b: a for a, b in pairs.both}
    place = {name: k for k, name in enumerate(left.view_names)}
    others = {name: len(place) + k for k, name in enumerate(pairs.right_only)}
    of_right = [place[partner[name]] if name in partner else others[name] for name in right.view_names]
    names = (*left.view_names, *pairs.right_only)
    return FrameNames(names, (np.arange(len(place)), np.array(of_right, dtype=np.intp)))


def _of_other_planes(left: Correspondences, right: Correspondences, pairs: ViewPairs) -> bool:
    """Whether pairs of views show other planes of a target, whose ids name them, so no point in common."""
    planes = []
    for one, names in zip((left, right), zip(*pairs.both, strict=True), strict=True):
        if one.point is None:
            return False
        paired = np.isin(one.view_names, names)[one.view_index]
        ids = np.unique(np.asarray(one.point)[paired].astype(str))
        if not planes_are_named(ids):
            return False
        planes.append({label.split("/")[0] for label in ids.tolist()})
    return planes[0].isdisjoint(planes[1])


def _without_camera(camera: str, names: Sequence[str]) -> list[str]:
    """The names of one camera's views without the words for the camera."""
    words = re.compile(rf"(?<![a-z])(?:{re.escape(camera)}(?![0-9])|{_ANY_CAMERA})(?![a-z])", re.IGNORECASE)
    keys: dict[str, str] = {}
    for name in names:
        key = re.sub(r"[\W_]+", "_", words.sub("", name)).strip("_") or name
        if key in keys:
            raise InputError(
                f"camera {camera}: the views {keys[key]!r} and {name!r} are both {key!r} without the name "
                "of the "
                "camera; give views that were taken together the same name in all cameras"
            )
        keys[key] = name
    return list(keys)


def check_one_target(points: Mapping[str, Correspondences]) -> None:
    """Refuse points in different units, or with ids of different places in different cameras."""
    (first, reference), *others = points.items()
    for name, one in others:
        if one.unit != reference.unit:
            raise InputError(
                f"camera {first} is in {reference.unit}, {name} in {one.unit}; give all in the same unit"
            )
    seen: dict[bytes, str] = {}
    for name, one in points.items():
        before = seen.setdefault(one.pixels[one.view_index == 0].tobytes(), name)
        if before != name:
            raise InputError(
                f"cameras {before} and {name} have the same points ({reference.source}, {one.source}); "
                "give the "
                "points of each camera once"
            )
    if any(one.point is None for one in points.values()):
        return
    ids = np.concatenate([np.asarray(one.point).astype(str) for one in points.values()])
    moved = first_moved(np.concatenate([one.world for one in points.values()]), ids)
    if moved is None:
        return
    starts = np.cumsum([0, *(len(one) for one in points.values())])
    where = []
    for row in moved:
        camera = int(np.searchsorted(starts, row, side="right")) - 1
        name, one = list(points.items())[camera]
        own = int(row - starts[camera])
        where.append((name, one.place(own), one.world[own], str(np.asarray(one.point)[own])))
    (name, place, world, label), (other, _, world_before, _) = where
    if name == other:
        return  # several targets in one file, as for a single camera
    at = [f"({', '.join(f'{x:g}' for x in xyz)})" for xyz in (world, world_before)]
    raise InputError(
        f"{place}: the point {label[:60]!r} is at {at[0]}, but at {at[1]} in the points of camera {other}; "
        "use one "
        "board and one unit for all cameras"
    )


def groups(linked: NDArray[np.bool_]) -> list[list[int]]:
    """Groups of cameras that are linked, directly or through others, by a symmetric matrix (C, C)."""
    left, found = set(range(len(linked))), []
    while left:
        group, open_ends = set(), {min(left)}
        while open_ends:
            group |= open_ends
            open_ends = {int(k) for k in np.flatnonzero(linked[sorted(open_ends)].any(axis=0))} - group
        found.append(sorted(group))
        left -= group
    return found


def refuse_apart(names: Sequence[str], linked: NDArray[np.bool_]) -> None:
    """Refuse cameras that no frame connects with the first one."""
    parts = groups(linked)
    if len(parts) == 1:
        return
    told = " | ".join(name_some(names[k] for k in part) for part in parts)
    raise InputError(
        f"these cameras have no view in common with the others: {told}; add views in which a camera of one "
        "group "
        "and a camera of another see the board at the same moment, under the same name"
    )
