"""The frames of a rig: which views of which cameras were taken at one moment.

Views of one name are one frame. If no two cameras have a name in common, names are compared without the name
of the camera, and without words such as ``cam0`` or ``left`` (``cam2_017`` and ``cam3_017`` are one frame).

Pairing of the views and the points of two cameras.

Views with equal names are a pair. If the cameras have no name in common, names are compared without the word
for the side: ``left``, ``l`` or ``cam0`` in names of the left camera, ``right``, ``r`` or ``cam1`` in names
of the right one. The word may have any case and must not be next to other letters (``left01`` and
``right01``, ``IMG_L_07`` and ``IMG_R_07``, ``cam0-3`` and ``cam1-3``); but one with a capital may follow a
small letter (``imageL0`` and ``imageR0``). The order of the views never matters.

The points of a pair of views are paired by their ids or, if one of the files has none, by X, Y, Z.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.verdict.findings import in_sequence, name_some
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import planes_are_named
from neurocal_cli.observations.labels import first_repeat, most_moved
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import distinct_points

_ANY_CAMERA = r"cam(?:era)?[ _-]?[0-9]+(?![0-9])|left|right"


_SIDES = (
    re.compile(
        r"(?<![a-z])(?:left|l(?![a-z])|cam(?:era)?[ _-]?0(?![0-9]))(?![a-z])"
        r"|(?-i:(?<=[a-z])L(?:eft)?(?![A-Za-z]))",
        re.IGNORECASE,
    ),
    re.compile(
        r"(?<![a-z])(?:right|r(?![a-z])|cam(?:era)?[ _-]?1(?![0-9]))(?![a-z])"
        r"|(?-i:(?<=[a-z])R(?:ight)?(?![A-Za-z]))",
        re.IGNORECASE,
    ),
)
_LEAST_COMMON = 0.1  # share of the points; fewer common X, Y, Z are a coincidence


ViewPairs = Sequence[tuple[str, str]]
"""Names of views of a left and a right camera that were taken together."""


@frozen_dataclass(eq=False)
class Pairs:
    """Points of both cameras: rows of each camera's points (N,), and the pair of views of each."""

    left: NDArray[np.intp]
    right: NDArray[np.intp]
    view: NDArray[np.intp]  # (N,) number of the pair, sorted


def pair_views(left: Sequence[str], right: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Pair the names of two cameras' views, in the order of the left one.

    Errors are no view, no pair, ambiguous names, and names that show that the cameras are swapped.
    """
    for side, names in (("left", left), ("right", right)):
        if not names:
            raise InputError(
                f"the calibration of the {side} camera has no points of its own; give a file that was not "
                "written with --lean"
            )
    if not set(left).isdisjoint(right):
        keys = dict(zip(left, left, strict=True)), dict(zip(right, right, strict=True))
    else:
        crossed = [name for name in left if _SIDES[1].search(name) and not _SIDES[0].search(name)]
        other = [name for name in right if _SIDES[0].search(name) and not _SIDES[1].search(name)]
        if len(crossed) == len(left) and len(other) == len(right):
            raise InputError(
                f"the cameras are swapped: the left one's views are {_listed(crossed)}, the right one's "
                f"{_listed(other)}; give the left camera first"
            )
        keys = _keys(left, _SIDES[0], None), _keys(right, _SIDES[1], None)
    both = tuple((name, keys[1][key]) for key, name in keys[0].items() if key in keys[1])
    if not both:
        raise InputError(
            f"no view of the left camera has a partner in the right one: left has {_listed(left)}, right has "
            f"{_listed(right)}; give views taken together the same name, or names such as left01 and "
            "right01, in which left and right touch no other letter"
        )
    return both


def unpaired(
    left: Iterable[str], right: Iterable[str], pairs: ViewPairs
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the views of the left camera alone and of the right camera alone."""
    sides = (left, {a for a, _ in pairs}), (right, {b for _, b in pairs})
    alone, other = (tuple(name for name in names if name not in paired) for names, paired in sides)
    return alone, other


def _keys(names: Sequence[str], words: re.Pattern[str], camera: str | None) -> dict[str, str]:
    """Names by their rest without the words for the camera.

    Names without such a word are left out of two cameras; of a named one of several cameras they stay.
    """
    keys: dict[str, str] = {}
    for name in names:
        key, found = words.subn("", name)
        if not found and camera is None:
            continue
        key = re.sub(r"[\W_]+", "_", key).strip("_") or (name if camera else "")
        if key in keys:
            whose = f"camera {camera}: " if camera else ""
            raise InputError(
                f"{whose}the views {keys[key]!r} and {name!r} are both {key!r} without the name of the "
                "camera; give views that were taken together the same name in all cameras"
            )
        keys[key] = name
    return keys


def _listed(names: Sequence[str]) -> str:
    return name_some(repr(name[:60]) for name in names)


def pair_points(left: Correspondences, right: Correspondences, views: ViewPairs) -> Pairs:
    """Pair the points of paired views.

    Errors are different units, no common point, ids of different places, and several points at one place.
    """
    if left.unit != right.unit:
        raise InputError(
            f"{left.source} is in {left.unit}, {right.source} in {right.unit}; give both in the same unit"
        )
    sides = _in_pairs(left, [a for a, _ in views]), _in_pairs(right, [b for _, b in views])
    rows, order = zip(*sides, strict=True)
    by_id = left.point is not None and right.point is not None
    if by_id:
        ids = [np.asarray(side.point)[row].astype(str) for side, row in zip((left, right), rows, strict=True)]
        codes = np.unique(np.concatenate(ids), return_inverse=True)[1].reshape(-1)
    else:
        _, codes, _ = distinct_points([left.select(rows[0]), right.select(rows[1])])
    n_codes = 1 + int(codes.max(initial=0))
    parts = np.split(codes, [len(rows[0])])
    keys = [view * n_codes + code for view, code in zip(order, parts, strict=True)]
    for points, row, key in zip((left, right), rows, keys, strict=True):
        if (repeat := first_repeat(key, np.full(len(key), ""))) is not None:  # no view has an id twice
            later, first = (points.place(int(row[k])) for k in repeat)
            raise InputError(
                f"{later}: the point is at the same X, Y, Z (in the same view) as {first}; remove one of the "
                "rows, or give a column point with an id of each point in both files"
            )
    common, first, second = np.intersect1d(keys[0], keys[1], assume_unique=True, return_indices=True)
    if not common.size or (not by_id and len(common) < _LEAST_COMMON * min(map(len, rows))):
        what, few = "id" if by_id else "X, Y, Z", f"{len(common)} points" if common.size else "no point"
        raise InputError(
            f"{left.source} and {right.source}: the paired views have {few} in common, by {what}; measure "
            "the same target in both, in the same coordinates and unit"
        )
    pairs = Pairs(rows[0][first], rows[1][second], common // n_codes)
    if by_id:
        _refuse_moved({"left": left, "right": right})
    return pairs


def _in_pairs(points: Correspondences, names: list[str]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of paired views, and the number of the pair of each."""
    place = {name: k for k, name in enumerate(names)}
    pair = np.array([place.get(name, -1) for name in points.view_names])[points.view_index]
    rows = np.flatnonzero(pair >= 0)
    return rows, pair[rows]


@frozen_dataclass(eq=False)
class FrameNames:
    """The frames of the views of several cameras."""

    names: tuple[str, ...]  # of the frames, in the order in which the cameras saw them
    of_views: tuple[NDArray[np.intp], ...]  # of each camera, (V_c,) frame of each view

    @property
    def sequence(self) -> NDArray[np.intp]:
        """(V,) the frames in the order of their names."""
        return np.array(in_sequence(self.names), dtype=np.intp)

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
        keys = [list(_keys(names, _words(camera), camera)) for camera, names in views.items()]
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
    return frames_of_pairs(left.view_names, right.view_names, pairs)


def frames_of_pairs(
    left: Sequence[str], right: Sequence[str], pairs: Sequence[tuple[str, str]]
) -> FrameNames:
    """The frames of the views of two cameras, of which some are paired."""
    partner = {b: a for a, b in pairs}
    names = (*left, *(name for name in right if name not in partner))
    place = {name: k for k, name in enumerate(names[len(left) :], len(left))}
    place |= {b: left.index(a) for b, a in partner.items()}
    return FrameNames(names, (np.arange(len(left)), np.array([place[name] for name in right], dtype=np.intp)))


def _of_other_planes(left: Correspondences, right: Correspondences, pairs: ViewPairs) -> bool:
    """Whether pairs of views show other planes of a target, whose ids name them, so no point in common."""
    planes = []
    for one, names in zip((left, right), zip(*pairs, strict=True), strict=True):
        if one.point is None:
            return False
        paired = np.isin(one.view_names, names)[one.view_index]
        ids = np.unique(np.asarray(one.point)[paired].astype(str))
        if not planes_are_named(ids):
            return False
        planes.append({label.split("/")[0] for label in ids.tolist()})
    return planes[0].isdisjoint(planes[1])


def _words(camera: str) -> re.Pattern[str]:
    """Words for a camera in the names of its views."""
    return re.compile(rf"(?<![a-z])(?:{re.escape(camera)}(?![0-9])|{_ANY_CAMERA})(?![a-z])", re.IGNORECASE)


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
                f"cameras {before} and {name} have the same points ({points[before].source}, {one.source}); "
                "give the points of each camera once"
            )
    _refuse_moved(points)


def _refuse_moved(points: Mapping[str, Correspondences]) -> None:
    """Refuse ids of different places in different cameras."""
    if any(one.point is None for one in points.values()):
        return
    ids = np.concatenate([np.asarray(one.point).astype(str) for one in points.values()])
    moved = most_moved(np.concatenate([one.world for one in points.values()]), ids)
    if moved is None:
        return
    starts, where = np.cumsum([0, *(len(one) for one in points.values())]), []
    for row in moved:
        camera = int(np.searchsorted(starts, row, side="right")) - 1
        where.append((list(points.values())[camera], row - int(starts[camera])))
    (one, own), (other, _) = where
    if one is other:
        return  # several targets in one file, as for a single camera
    places = [f"({', '.join(f'{x:g}' for x in some.world[at])})" for some, at in where]
    raise InputError(
        f"{one.place(own)}: the point {str(ids[moved[0]])[:60]!r} is at {places[0]}, but at {places[1]} in "
        f"{other.source}; use one board and one unit for all cameras"
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
        "group and a camera of another see the board at the same moment, under the same name"
    )
