"""Read a camera from a dictionary by the many names that programs and people give to its parts.

What is found gets the keys of `camera_names`, which the tables of formats have. The names may have that of
one camera of two before or after them (``cameraMatrix1``, ``left_K``). Nothing is guessed: four coefficients
that may be those of an ordinary lens or of a fisheye are refused, and so are numbers that may be the
distortion and were not read, because a camera without its distortion looks right but is wrong.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import MODELS
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import InputError, one_line
from neurocal_cli.files.camera_tree import matrix_data
from neurocal_cli.files.exchange.camera_names import (
    ALIKE,
    ENTRIES,
    HARMLESS,
    NAMES,
    UNKNOWN,
    flat,
    has_entries,
    have_gap,
    is_four,
    is_matrix,
    is_numbers,
    matrix_of,
    may_be_distortion,
    means,
    parameters_apart,
)
from neurocal_cli.files.exchange.document import NoCameraError, camera_matrix
from neurocal_cli.files.tree_fields import Field, plain

_ROUNDED = 1e-3  # share of the focal length by which two statements of it differ at most
# A smaller focal length [px, share of the image's width] whose name tells no unit may be in mm.
_LEAST_FOCAL, _LEAST_SHARE = 200.0, 0.2


class LooseKeys:
    """The keys of a mapping by their plain names, and those that were read.

    `distortion` is the model of the coefficients if the file does not say it, and `notes` are appended to.
    """

    def __init__(self, root: Field, distortion: str | None = None, notes: list[str] | None = None) -> None:
        self.root, self.distortion = Field(parameters_apart(root.value), root.source, root.path), distortion
        self.notes = [] if notes is None else notes
        self.names: dict[str, list[str]] = {}
        for key in self.root.value:
            self.names.setdefault(plain(str(key)), []).append(key)
        self.read: set[str] = set()

    def find(
        self,
        key: str,
        side: str = "",
        fits: Callable[[Any], bool] = lambda _: True,
        others: Iterable[str] = (),
    ) -> Field | None:
        """Value of the first name of a key that is there and fits; a second one that differs is refused."""
        keys = [
            name
            for form in (*_forms(key, side), *others)
            for name in self.names.get(form, [])
            if name in self.root and fits(self.root.value[name])
        ]
        if not keys:
            return None
        first = self.root[keys[0]]
        for other in keys[1:]:
            if is_numbers(first.value) and is_numbers(self.root.value[other]):
                if flat(self.root.value[other]) != flat(first.value):
                    self.root.refuse(f"{keys[0]} and {other} differ, and both may be meant; remove one")
                self.read.add(other)
        self.read.add(keys[0])
        return first

    def has_camera(self, side: str = "") -> bool:
        """Whether there is a camera matrix, or its entries, under their usual names."""
        matrix = any(
            is_matrix(self.root.value[key])
            or (len(key) > 1 and (has_entries(self.root.value[key]) or is_four(self.root.value[key])))
            for name in ("original_matrix", "camera_matrix")
            for form in _forms(name, side)
            for key in self.names.get(form, [])
        )
        return matrix or (not side and has_entries(self.root.value))

    def tree(self, side: str = "") -> dict[str, Any]:
        """The camera, or that of one side, under the keys of the table."""
        inside = self.find("camera_matrix", side, has_entries)
        if inside is not None:  # it may hold the coefficients and the size as well
            own = {f"{key}_{side}" if side else key: value for key, value in inside.value.items()}
            if not own.keys() <= self.root.value.keys():
                root = Field({**self.root.value, **own}, self.root.source)
                merged = LooseKeys(root, self.distortion, self.notes)
                tree = merged.tree(side)
                self.read |= merged.read
                self.coefficients_read |= merged.coefficients_read
                merged.refuse_unread()
                return tree
        K, lens = self._matrix(side), self._lens(side)
        stated = self.find("camera_name", side, lambda value: isinstance(value, (str, int)))
        size = self.image_size(side)
        return {
            "camera_name": "camera" if stated is None else stated.text(),
            **({} if size is None else dict(zip(("image_width", "image_height"), size, strict=True))),
            "camera_matrix": K.tolist(),
            **lens,
        }

    def image_size(self, side: str = "") -> tuple[int, int] | None:
        """Width and height [px]; None if they are unknown."""

        def find(key: str) -> Field | None:
            found = (self.find(key, one) for one in dict.fromkeys((side, "")))
            return next((field for field in found if field is not None), None)

        width, height, field = map(find, ("image_width", "image_height", "image_size"))
        if width is not None and height is not None:
            sides = width.integer(), height.integer()
            stated = [] if field is None else [int(n) for n in flat(field.value) if np.isfinite(n)]
            if field is not None and stated and sorted(stated) != sorted(sides):
                self.root.refuse(f"{field.path} and {width.path}, {height.path} differ; remove one")
            return None if 0 in sides else sides
        turned = field is None
        field = self.find("image_shape") if field is None else field
        if field is None:
            return None
        if isinstance(field.value, dict) and not is_numbers(field.value):
            return LooseKeys(field).image_size()
        numbers = re.findall(r"\d+", field.value) if isinstance(field.value, str) else flat(field.value)
        if len(numbers) != 2 and not (turned and len(numbers) == 3):
            field.fail("two whole numbers, width and height")
        first, second = (Field(float(n), field.source, field.path).integer() for n in numbers[:2])
        return None if 0 in (first, second) else (second, first) if turned else (first, second)

    def refuse_unread(self, every: bool = False) -> None:
        """Refuse numbers that may be the distortion and were not read; `every` number of a mapping of it."""
        for key, value in self.root.value.items():
            guess = not self.coefficients_read
            if key not in self.read and may_be_distortion(str(key), value, guess, every or self.lacks):
                raise InputError(
                    f"the key {str(key)[:60]!r} may be the distortion, and is not a known name of it; rename "
                    "it to distortion_coefficients, or remove it"
                )

    def note_others(self) -> None:
        """Append a note on each other matrix that may be the camera's."""
        for key, value in self.root.value.items():
            if key in self.read or HARMLESS.search(plain(str(key))) or not isinstance(value, list):
                continue
            if len(value) == 3 and camera_matrix(value) is not None:
                self.notes.append(
                    f"{self.root.source}: {str(key)[:60]!r} looks like another camera matrix, and is not read"
                )

    coefficients_read = False
    lacks = False  # a coefficient, beside others

    def _matrix(self, side: str) -> Array:
        field = (
            self.find("original_matrix", side, is_matrix)
            or self.find("camera_matrix", side, lambda v: is_matrix(v) or has_entries(v))
            or (self.root if not side and has_entries(self.root.value) else None)
            or self.find("camera_matrix", side, lambda v: not _is_mapping(v) or "rows" in v)  # a damaged one
        )
        if field is None:
            keys = ", ".join(str(key)[:30] for key in list(self.root.value)[:6])
            raise NoCameraError(
                "holds no camera matrix; give a file with the key camera_matrix, cameraMatrix or K"
                f"{f' (its keys are {one_line(keys)})' if keys else ''}"
            )
        if isinstance(field.value, dict) and has_entries(field.value):
            K = (self if field is self.root else LooseKeys(field))._of_entries()
        elif isinstance(field.value, list) and len(field.value) == 4:
            K = matrix_of(*field.array(4).tolist())
        else:
            K = matrix_data(field, 9).reshape(3, 3)
            if not K[:2, 2].any() and K[2, :2].all():
                if isinstance(field.value, list) and isinstance(field.value[0], list):
                    raise InputError(
                        f"{field.path} is transposed, as MATLAB writes it; write its columns as rows, and of "
                        "MATLAB's, whose first pixel is 1, subtract 1 from the principal point"
                    )
                K = K.T  # Apple's matrices are by columns
        if not K.any():
            raise InputError(f"{field.path} is 0: the camera is not calibrated; calibrate it first")
        if K[2, 2] != 1:
            raise InputError(
                f"{field.path}: its last entry must be 1, found {K[2, 2]:g}; divide the matrix by it"
            )
        four = [self.names[name][0] for key in ENTRIES for name in NAMES[key] if name in self.names]
        stated = [flat(self.root.value[key]) for key in four]
        if field is not self.root and not side and [len(one) for one in stated] == [1] * len(ENTRIES):
            shift = np.ravel(stated) - [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
            if np.abs(shift).max() > _ROUNDED * K.max():
                both = f"{field.path} and {', '.join(four)}"
                self.root.refuse(f"{both} differ, and both may be meant; remove one")
        try:
            Intrinsics.from_matrix(K)
        except InputError as error:
            raise InputError(f"{field.path}: {error}; correct it") from error
        return K

    def _of_entries(self) -> Array:
        """Camera matrix of fx, fy, cx, cy and the skew, or of the focal length and the principal point."""
        found = [self.find(key, "", lambda v: not isinstance(v, (dict, list))) for key in ENTRIES]
        four = [entry.number() for entry in found if entry is not None]
        if len(four) < 4:
            focal, centre = (self.find(key, "", is_numbers) for key in ("focal_length", "principal_point"))
            if focal is None:
                stated = self.find("focal_length")
                if stated is None:
                    self.root.refuse("has no focal length")
                stated.fail("a number")
            own = four[-2:] if centre is None else flat(centre.value)
            four = [*(2 * flat(focal.value))[:2], *own]
            size = self.image_size()
            likely = [name for name in self.names if "aspect" in name or "ratio" in name]
            ratio = self.find("aspect_ratio", "", lambda v: isinstance(v, (int, float)), likely)
            if len(flat(focal.value)) == 1 and ratio is not None and ratio.number() not in (0, 1):
                raise InputError(
                    f"has one focal length and {ratio.path}, which programs take as fy / fx or fx / fy; give "
                    "fx and fy"
                )
            if len(four) != 4 or four[0] < (_LEAST_FOCAL if size is None else _LEAST_SHARE * size[0]):
                raise InputError(
                    f"{focal.path} is not told to be in pixels; give a file with fx, fy, cx and cy in pixels"
                )
        skew = self.find("skew", "", is_numbers)
        fx, fy, cx, cy = four
        return matrix_of(fx, fy, cx, cy, 0.0 if skew is None else skew.number())

    def _stated_model(self, side: str) -> str | None:
        """ROS's name of the distortion model that the file states; None if it states none."""
        stated: dict[str, str] = {}
        inner = self.find("distortion_coefficients", side, _is_mapping)
        if inner is not None and (model := LooseKeys(inner)._stated_model("")) is not None:
            stated[model] = inner.path
        for key in ("distortion_model", "camera_model"):
            for s in dict.fromkeys((side, "")):
                field = self.find(key, s, lambda value: isinstance(value, str))
                if field is None:
                    continue
                word, own = field.text(), key == "distortion_model"
                model = means(word) if word.strip() else "plumb_bob" if own else None
                if own and model is None:
                    model = "none" if plain(word) in ("none", "nodistortion") else word
                if model is not None:
                    stated.setdefault(model, field.text())
                    break
        for name in () if side and stated else NAMES["fisheye_model"]:
            field = self.find(name, "", lambda v: v in (0, 1, True, False, "true", "false", "0", "1"))
            if field is not None:
                yes = field.value in (1, True, "true", "1")
                stated.setdefault("equidistant" if yes else "plumb_bob", f"{field.path} {field.value}")
        strong = [model for model in stated if model != "pinhole"]
        kinds = {"plumb_bob" if model in ALIKE else model for model in strong}
        if len(kinds) > 1:
            words = " and ".join(repr(stated[model][:40]) for model in strong)
            raise InputError(f"names two distortion models, {words}; remove the one that is not meant")
        if strong:
            return next((model for model in strong if model != "plumb_bob"), strong[0])
        return "plumb_bob" if stated else None

    def _lens(self, side: str) -> dict[str, Any]:
        """The distortion under the keys of the table."""
        xi = self.find("xi", side, is_numbers)
        k, named = self._coefficients(side)
        model = self._stated_model(side)
        if model is None and k is None and xi is not None and self.find("alpha", side, is_numbers):
            model = "double_sphere"
        if model in ("double_sphere", "eucm") and k is None:
            found = [self.find(name, side, is_numbers) for name in MODELS[model]]
            if any(found) and not all(found):
                raise InputError(
                    f"has not all of {', '.join(MODELS[model])}, the coefficients of {model}; add them"
                )
            if all(found):
                return _lens(model, [entry.number() for entry in found if entry])
        if k is None:
            self.lacks = model == UNKNOWN
            if xi is not None:
                raise InputError(
                    "has xi of an omnidirectional camera without its distortion; add D, or zeros"
                )
            return {"distortion_model": "none"}
        self.coefficients_read = True
        if model in (UNKNOWN, "none"):
            if not any(k):
                return _lens("none")
            if model == UNKNOWN:
                raise InputError(
                    "its distortion model is not known here; calibrate with OpenCV's model or its fisheye, "
                    "or with neurocal from the points"
                )
            raise InputError("states that there is no distortion, and has coefficients of it; remove one")
        if xi is not None:
            return _omnidirectional(xi, k, "omnidir" if model is None else model)
        if model is None and self.distortion is not None:
            return _given(self.distortion, k)
        if model is None and len(k) == 4 and any(k) and not named:
            raise InputError(
                "has four distortion coefficients, and does not say whether they are k1, k2, p1, p2 of an "
                "ordinary lens or k1 to k4 of a fisheye; convert it with --distortion k1k2p1p2 or fisheye"
            )
        if model == "omnidir" and len(k) == len(MODELS[model]):
            return {**_lens(model, k[1:]), "xi": k[0]}
        return _lens(model or "plumb_bob", k)

    def _coefficients(self, side: str) -> tuple[list[float] | None, bool]:
        """Coefficients in OpenCV's order, and whether their names tell that p1 and p2 are among them."""
        field = self.find("distortion_coefficients", side, lambda v: not isinstance(v, (str, int, float)))
        if field is not None:
            if _is_mapping(field.value):
                inner = LooseKeys(field)
                found = inner._coefficients("")
                inner.refuse_unread(every=True)
                return found
            return matrix_data(field, -1).tolist(), False
        radial, tangential = (
            self.find(f"{kind}_distortion", side, is_numbers) for kind in ("radial", "tangential")
        )
        if radial is tangential is None and not side:  # mmpose and VoxelPose
            radial = self.find("k", "", lambda v: _count(v) in (2, 3, 6))
            tangential = self.find("p", "", lambda v: _count(v) == 2)
        if radial is None and tangential is not None and any(flat(tangential.value)):
            tangential.refuse(f"has {tangential.path}, and no radial coefficients under a known name")
        if radial is not None:
            single = isinstance(radial.value, (int, float))
            k = [radial.number()] if single else matrix_data(radial, -1).tolist()
            if tangential is None and radial.path.rpartition(".")[2] in ("k", "K"):
                radial.refuse("has k and no p; add p, the two tangential coefficients, or zeros")
            p = [0.0, 0.0] if tangential is None else matrix_data(tangential, 2).tolist()
            if len(k) not in (1, 2, 3, 6):
                radial.fail("2, 3 or 6 numbers")
            return [*[*k, 0.0][:2], *p, *(k[2:] or [0.0])], True
        values = {}
        for name in MODELS["rational"]:
            entry = self.find(name, side, lambda v: is_numbers(v) and not isinstance(v, (list, dict)))
            if entry is not None:
                values[name] = entry.number()
        if not values:
            return None, False
        self.lacks = have_gap(values)
        if "k4" in values and not {"p1", "p2", "k5", "k6"} & set(values):  # as in a fisheye
            return [values.get(name, 0.0) for name in MODELS["fisheye"]], False
        full = [values.get(name, 0.0) for name in MODELS["rational"]]
        return full if any(full[5:]) else full[:5], True


def _forms(key: str, side: str) -> list[str]:
    """The plain names of a key, of one side before and after it."""
    names = NAMES.get(key, (key,))
    return [form for name in names for form in (name + side, side + name)] if side else [*names]


def _is_mapping(value: Any) -> bool:
    return isinstance(value, dict) and "data" not in value


def _count(value: Any) -> int:
    return len(flat(value)) if isinstance(value, list) else 0


def _lens(model: str, k: Iterable[float] = ()) -> dict[str, Any]:
    return {"distortion_model": model, "distortion_coefficients": [*k]}


def _omnidirectional(xi: Field, k: list[float], model: str) -> dict[str, Any]:
    """Distortion of OpenCV's omnidirectional camera, whose xi is a separate key."""
    value = xi.number() if isinstance(xi.value, (int, float)) else float(matrix_data(xi, 1)[0])
    k = k if any(k[4:]) else k[:4]
    if model != "omnidir" or len(k) != 4:
        raise InputError(
            f"has xi of an omnidirectional camera, and {len(k)} coefficients of the distortion "
            f"model {model[:40]!r}; give k1, k2, p1, p2, and omnidir or no model"
        )
    return {**_lens(model, k), "xi": value}


def _given(model: str, k: list[float]) -> dict[str, Any]:
    """Coefficients of the model that the caller names, in OpenCV's order."""
    count = len(MODELS[model])
    if len(k) < (count if model in WIDE else 0) or any(k[count:]):
        raise InputError(
            f"has {len(k)} distortion coefficients, and {model} has {count}; give another --distortion"
        )
    return _lens(model, [*k, *(count - len(k)) * [0.0]][:count])
