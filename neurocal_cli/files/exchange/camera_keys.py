"""Tables of the keys of one camera in a program's files, by which it is read and written.

The paths of the keys are those of `tree_paths`. A lens is a line ``"names: model places"``: what the program
calls it, by commas, of which the first is written; our name of the model; and the place of each of its
coefficients in order, or one of the list of all. ``-`` is a coefficient that the program does not have,
``D/*`` are our own names of all below D, and after ``of`` stand the places of the camera matrix, if they are
not those of other lenses. Without names, all cameras have this lens. Case and punctuation of names do not
count.
"""

from __future__ import annotations

from functools import cached_property
from itertools import accumulate, chain
from typing import Any

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import MODELS, WITH_PRISM, Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.nearest_camera import with_model
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import InputError
from neurocal_cli.files.camera_tree import matrix_data
from neurocal_cli.files.exchange.camera_names import have_gap, matrix_of, may_be_distortion
from neurocal_cli.files.exchange.tree_paths import at, find, listed, numbers_at, put, split
from neurocal_cli.files.tree_fields import Field, plain

NOTHING = "-"  # the place of a coefficient that a program does not have
_BOOLEANS = {"false": False, "true": True}  # names of lenses
_POLYNOMIAL = ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "rational", "thin_prism", "tilted")


@frozen_dataclass
class Lens:
    """A distortion model of a program."""

    words: tuple[str, ...]
    ours: str
    places: list[str]
    intrinsics: list[str]

    @staticmethod
    def of(line: str) -> Lens:
        """The lens of a line of a table."""
        words, _, rest = line.rpartition(": ")
        rest, _, own = rest.partition(" of ")
        ours, *places = rest.split()
        starred = (place.replace("*", ",".join(MODELS[ours])) for place in places)
        return Lens(tuple(map(str.strip, words.split(","))), ours, listed(" ".join(starred)), listed(own))


@frozen_dataclass(eq=False)
class CameraKeys:
    """Where a program's files have the parts of one camera."""

    program: str
    intrinsics: str = ""  # fx, fy, cx, cy, or one path of them or of the camera matrix
    lenses: str = ""  # of several with one name, the last has the coefficients of the others
    start: str = ""  # what stands before all keys of a file
    model: str = ""  # path of the name of the lens, or of its parts; without it, the first lens
    size: str = ""  # width and height, or one path of both
    name: str = ""
    skew: str = ""
    aspect: str = ""  # of fy over fx, where the intrinsics have fx for both
    first_pixel: float = 0.0  # coordinate of the centre of the first pixel
    from_middle: bool = False  # whether the principal point is counted from the middle of the image
    by_longer_side: bool = False  # whether all are divided by the longer side of the image
    optional: str = ""  # which coefficients a file may lack: all at once, or any
    aside: str = ""  # other numbers beside those of the camera
    complete: bool = False  # whether there are no others
    advice: str = "calibrate it as"  # what to do with a camera of another model: this, one of them

    @cached_property
    def table(self) -> tuple[Lens, ...]:
        """The lenses."""
        return tuple(Lens.of(line) for line in self.lenses.strip().splitlines())

    @property
    def models(self) -> tuple[str, ...]:
        """Our names of the models that can be written, the simplest first."""
        ours = [lens.ours for lens in self.table]
        return tuple(dict.fromkeys([*([] if set(ours).isdisjoint(_POLYNOMIAL) else ["none"]), *ours]))

    @property
    def top(self) -> frozenset[str]:
        """The first keys of the paths of the lens, the intrinsics and the size."""
        paths = *listed(self.intrinsics), *listed(self.size), *split(self.model)
        return frozenset(self.start + path.partition(":")[0].partition("/")[0] for path in paths if path)

    def camera(self, root: Field, name: str = "camera") -> Camera:
        """Read a camera."""
        lens = self._lens(root)
        paths = lens.intrinsics or listed(self.intrinsics)
        if len(paths) == 1:
            entries = numbers_at(root, paths[0])
            if len(entries) not in (4, 9):
                at(root, paths[0]).fail("four numbers or a 3 x 3 matrix")
            K = matrix_of(*entries) if len(entries) == 4 else entries.reshape(3, 3).copy()
            if not np.array_equal(K[2], [0, 0, 1]):
                at(root, paths[0]).fail("a 3 x 3 matrix whose last row is 0, 0, 1")
        else:
            K = matrix_of(*(at(root, path).number() for path in paths))
        if self.aspect:
            K[1, 1] *= at(root, self.aspect).number()
        if self.skew and (skew := find(root, self.skew)) is not None:
            K[0, 1] = skew.number()
        size = self.image_size(root)
        if size is None and (self.from_middle or self.by_longer_side):
            at(root, listed(self.size)[0]).fail("the size of the images")
        K[:2] *= max(size or (1,)) if self.by_longer_side else 1.0
        K[:2, 2] += (0.5 * np.array(size) if self.from_middle else 0.0) - self.first_pixel
        if self.name and (stated := find(root, self.name)) is not None:
            name = stated.text()
        return Camera(Intrinsics.from_matrix(K), self._distortion(root, lens), size, name)

    def image_size(self, root: Field) -> tuple[int, int] | None:
        """Width and height; None if they are not there, or 0."""
        fields = [find(root, path) for path in listed(self.size)]
        known = [entry for entry in fields if entry is not None]
        if not known or len(known) < len(fields):
            return None
        entries = list(known[0].items()) if len(known) == 1 else known
        if len(entries) != 2:
            known[0].fail("two whole numbers, width and height")
        width, height = (entry.integer() for entry in entries)
        return (width, height) if width and height else None

    def _lens(self, root: Field) -> Lens:
        entries = [entry for path in split(self.model) if (entry := find(root, path)) is not None]
        stated = [str(one.value).lower() if type(one.value) is bool else one.text() for one in entries]
        if not stated:
            first = self._fullest(root, self.table[0])
            others = [one for one in self.table if one.ours != first.ours and one.places == first.places]
            if self.model and others and first.places:
                at(root, split(self.model)[0])  # the same numbers may be those of either
            return first
        word = plain("".join(stated))
        for lens in self.table:
            if word in map(plain, lens.words):
                return self._fullest(root, lens)
        known = ", ".join(dict.fromkeys(lens.words[0] for lens in self.table))
        raise InputError(
            f"the model {'-'.join(stated)[:40]!r} of {self.program} is not known; {self.advice} one of "
            f"{known}, or calibrate with neurocal from the points"
        )

    def _fullest(self, root: Field, lens: Lens) -> Lens:
        """The lens of the same names with the most coefficients, if possible of those that are there."""
        alike = [other for other in self.table if other.words == lens.words]
        there = [one for one in alike if all(path == NOTHING or find(root, path) for path in one.places)]
        return (there or alike)[-1]

    def _distortion(self, root: Field, lens: Lens) -> Distortion:
        count = len(MODELS[lens.ours])
        whole = not self.optional or lens.ours not in (*_POLYNOMIAL, "fisheye")
        lacking = False
        if count and len(lens.places) == 1 < count:
            found = at(root, lens.places[0]) if whole else find(root, lens.places[0])
            values = np.zeros(0) if found is None else matrix_data(found, -1)
        else:
            fields = {path: find(root, path) for path in lens.places if path != NOTHING}
            stated = any(fields.values())
            fewest = next(one for one in self.table if one.words == lens.words).places
            needed = lens.places if whole else []
            if stated and not whole:  # later coefficients alone are no distortion
                all_of = self.optional == "all" or lens.ours == "fisheye"
                needed = fewest if all_of else lens.places[:1]
            for path in needed:
                if path != NOTHING:
                    at(root, path)
            ours = zip(MODELS[lens.ours], lens.places, strict=True)
            lacking = have_gap([name for name, path in ours if fields.get(path) or path == NOTHING])
            values = np.array(
                [0.0 if (one := fields.get(path)) is None else one.number() for path in lens.places]
            )
        self._refuse_others(root, lens, self.complete or lacking)
        if lens.ours in _POLYNOMIAL[:4] and len(values) == count and values.any():
            return Distortion(lens.ours, values)
        if lens.ours in _POLYNOMIAL:
            return _ordinary(
                values if len(lens.places) == 1 else np.pad(values, (0, max(0, 5 - len(values))))
            )
        if not values[count:].any():
            values = values[:count]
        if len(values) != count:
            raise InputError(
                f"the model {lens.words[0]} has {count} coefficients, found {len(values)}; correct it"
            )
        return Distortion(lens.ours, values)

    def _refuse_others(self, root: Field, lens: Lens, every: bool) -> None:
        """Refuse what may be a coefficient or the name of another lens, and was not read.

        If `every`, because a coefficient is missing, each number may be it.
        """
        numbered = *listed(self.intrinsics), *lens.intrinsics, *lens.places
        others = *listed(self.size), *split(self.model), self.name, self.skew, self.aspect
        paths = [path.partition(":")[0] for path in (*numbered, *others) if path]
        different = [one for one in self.table if one.ours not in (lens.ours, "none")]
        words = {plain(word) for one in different for word in one.words if len(word) > 2}
        above = (accumulate(path.split("/")[:-1], "{}/{}".format) for path in paths)
        for folder in dict.fromkeys(["", *chain.from_iterable(above)]):
            parent = find(root, folder) if folder else root
            start = f"{folder}/" if folder else ""
            known = {path.removeprefix(start).partition("/")[0] for path in paths if path.startswith(start)}
            value, in_list = None if parent is None else parent.value, False
            if isinstance(value, list) and any(path.startswith(start) for path in numbered):
                value, in_list = {str(k): entry for k, entry in enumerate(value)}, True
            for key, entry in value.items() if isinstance(value, dict) else ():
                if key in known or key in self.aside.split():
                    continue
                if isinstance(entry, dict) and "val" in entry:
                    entry = entry["val"]
                named = isinstance(entry, str) and plain(entry) in words
                if named or may_be_distortion(f"k{key}" if in_list else key, entry, False, every):
                    place = f"{parent.path}." if parent is not None and parent.path else ""
                    what = f"coefficient {folder}[{key}]" if in_list else f"key {place + key[:60]!r}"
                    raise InputError(
                        f"the {what} is not known in {self.program}'s {lens.words[0] or 'cameras'}, and may "
                        "tell their distortion; correct its name, remove it, or calibrate with neurocal from "
                        "the points"
                    )

    def tree(self, camera: Camera) -> dict[str, Any]:
        """The tree of a camera, whose model is one of `models`."""
        fitting = (lens for lens in self.table if with_model(camera.distortion, lens.ours) is not None)
        lens = next(fitting)
        distortion = with_model(camera.distortion, lens.ours)
        assert distortion is not None
        a, skew, b, u0, v0 = camera.entries
        width, height = (camera.image_size or (0, 0)) if self.from_middle else (0, 0)
        u0, v0 = u0 - 0.5 * width + self.first_pixel, v0 - 0.5 * height + self.first_pixel
        tree: dict[str, Any] = {}
        if self.model:
            word = lens.words[0]
            put(tree, self.model, word.split("-") if "," in self.model else _BOOLEANS.get(word, word))
        if self.name:
            put(tree, self.name, camera.name)
        if self.size:
            _put_all(tree, listed(self.size), camera.image_size or (0, 0))
        paths = lens.intrinsics or listed(self.intrinsics)
        if ":" in paths[0] and not paths[0].endswith(":list"):
            put(tree, paths[0], matrix_of(a, b, u0, v0, skew))
        else:
            _put_all(tree, paths, [a, b, u0, v0])
        if self.skew:
            put(tree, self.skew, skew)
        _put_all(tree, lens.places, distortion.coefficients.tolist())
        return tree


def _ordinary(values: Array) -> Distortion:
    """OpenCV's coefficients in the smallest of its models that has them; all zeros are no distortion."""
    if not values.any():
        return Distortion()
    if len(values) not in (4, 5, 8, 12, 14):
        raise InputError(
            "distortion has 4, 5, 8, 12 or 14 coefficients k1,k2,p1,p2,k3,..,k6,s1,..,s4,tauX,tauY, found "
            f"{len(values)}"
        )
    models = ("plumb_bob", "rational", *WITH_PRISM)
    return Distortion(next(one for one in models if not values[len(MODELS[one]) :].any()), values)


def _put_all(tree: dict[str, Any], paths: list[str], values: Any) -> None:
    if len(paths) == 1 < len(values):
        put(tree, paths[0], np.array(values) if ":" in paths[0] and "list" not in paths[0] else list(values))
    else:
        for path, value in zip(paths, values, strict=True):
            if path != NOTHING:
                put(tree, path, value)
