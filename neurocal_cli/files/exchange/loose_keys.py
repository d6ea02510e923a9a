"""Read a camera from a dictionary by the many names that programs and people give to its parts.

The names may have that of one camera of two before or after them (``cameraMatrix1``, ``left_K``). Nothing is
guessed: four coefficients that may be those of an ordinary lens or of a fisheye are refused, and so are
numbers that may be the distortion and were not read, because a camera without its distortion looks right but
is wrong.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import MODELS, Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.given_values import checked_size
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import InputError, one_line, value_failures
from neurocal_cli.files.camera_tree import from_ros, matrix_data
from neurocal_cli.files.exchange.camera_names import (
    ALIKE,
    ASPECT,
    CENTRE,
    COEFFICIENTS,
    ENTRIES,
    FISHEYE,
    FOCAL,
    HARMLESS,
    HEIGHT,
    KIND,
    MATRIX,
    MODEL,
    NAME,
    ORIGINAL,
    RADIAL,
    SHAPE,
    SIZE,
    TANGENTIAL,
    UNKNOWN,
    WIDTH,
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
    plain,
)
from neurocal_cli.files.exchange.document import NoCameraError, camera_matrix
from neurocal_cli.files.tree_fields import Field

# A smaller focal length [px, share of the image's width] whose name tells no unit may be in mm.
_ROUNDED = 1e-3  # share of the focal length by which two statements of it differ at most
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
        self, names: Iterable[str], side: str = "", fits: Callable[[Any], bool] = lambda _: True
    ) -> Field | None:
        """Value of the first of these names that is there and fits; a second one that differs is refused."""
        forms = [form for name in names for form in ((name + side, side + name) if side else (name,))]
        keys = [
            key
            for form in dict.fromkeys(forms)
            for key in self.names.get(form, [])
            if key in self.root and fits(self.root.value[key])
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
            for name in (*ORIGINAL, *MATRIX)
            for form in ((name + side, side + name) if side else (name,))
            for key in self.names.get(form, [])
        )
        return matrix or (not side and has_entries(self.root.value))

    def camera(self, side: str = "", name: str = "camera") -> Camera:
        """Read the camera, or that of one side."""
        inside = self.find(MATRIX, side, has_entries)
        if inside is not None:  # it may hold the coefficients and the size as well
            own = {f"{key}_{side}" if side else key: value for key, value in inside.value.items()}
            if not own.keys() <= self.root.value.keys():
                root = Field({**self.root.value, **own}, self.root.source)
                merged = LooseKeys(root, self.distortion, self.notes)
                camera = merged.camera(side, name)
                self.read |= merged.read
                self.coefficients_read |= merged.coefficients_read
                merged.refuse_unread()
                return camera
        intrinsics = self._intrinsics(side)
        distortion = self._distortion(side)
        stated = self.find(NAME, side, lambda value: isinstance(value, (str, int)))
        return Camera(
            intrinsics, distortion, self.image_size(side), name if stated is None else stated.text()
        )

    def image_size(self, side: str = "") -> tuple[int, int] | None:
        """Width and height [px]; None if they are unknown."""
        sides = (side, "") if side else ("",)
        width, height = (
            next((field for s in sides if (field := self.find(names, s)) is not None), None)
            for names in (WIDTH, HEIGHT)
        )
        field = next((f for s in sides if (f := self.find(SIZE, s)) is not None), None)
        if width is not None and height is not None:
            size = width.integer(), height.integer()
            if field is not None and sorted(map(int, filter(np.isfinite, flat(field.value)))) not in (
                [],
                sorted(size),
            ):
                self.root.refuse(f"{field.path} and {width.path}, {height.path} differ; remove one")
        else:
            turned = False
            if field is None:
                turned, field = True, self.find(SHAPE)
            if field is None:
                return None
            if isinstance(field.value, dict) and not is_numbers(field.value):
                return LooseKeys(field).image_size()
            if isinstance(field.value, str):
                numbers: list[float] = [int(n) for n in re.findall(r"\d+", field.value)]
            else:
                numbers = flat(field.value)
            if len(numbers) != 2 and not (turned and len(numbers) == 3):
                field.fail("two whole numbers, width and height")
            values = [Field(n, field.source, field.path).integer() for n in numbers]
            size = (values[1], values[0]) if turned else (values[0], values[1])
        if 0 in size:
            return None
        with value_failures(self.root.source):
            return checked_size(size)

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

    def has_coefficients(self, side: str) -> bool:
        """Whether there are distortion coefficients of the camera of a side."""
        return self._coefficients(side)[0] is not None

    coefficients_read = False
    lacks = False  # a coefficient, beside others

    def _intrinsics(self, side: str) -> Intrinsics:
        field = self.find(ORIGINAL, side, is_matrix)
        if field is None:
            field = self.find(MATRIX, side, lambda value: is_matrix(value) or has_entries(value))
        if field is None and not side and has_entries(self.root.value):
            field = self.root
        if field is None:
            field = self.find(
                [n for n in MATRIX if len(n) > 1 or not side],
                side,
                lambda v: not isinstance(v, dict) or not {"data", "rows"}.isdisjoint(v),
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
        four = [self.names[name][0] for names in ENTRIES for name in names if name in self.names]
        stated = [flat(self.root.value[key]) for key in four]
        if field is not self.root and not side and [len(one) for one in stated] == [1] * len(ENTRIES):
            shift = np.ravel(stated) - [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
            if np.abs(shift).max() > _ROUNDED * K.max():
                both = f"{field.path} and {', '.join(four)}"
                self.root.refuse(f"{both} differ, and both may be meant; remove one")
        try:
            return Intrinsics.from_matrix(K)
        except InputError as error:
            raise InputError(f"{field.path}: {error}; correct it") from error

    def _of_entries(self) -> Array:
        """Camera matrix of fx, fy, cx, cy and the skew, or of the focal length and the principal point."""
        found = [self.find(names, "", lambda v: not isinstance(v, (dict, list))) for names in ENTRIES]
        four = [entry.number() for entry in found if entry is not None]
        if len(four) < 4:
            focal, centre = (self.find(names, "", is_numbers) for names in (FOCAL, CENTRE))
            if focal is None:
                stated = self.find(FOCAL)
                if stated is None:
                    self.root.refuse("has no focal length")
                stated.fail("a number")
            own = four[-2:] if centre is None else flat(centre.value)
            four = [*(2 * flat(focal.value))[:2], *own]
            size = self.image_size()
            ratio = self.find(ASPECT, "", is_numbers)
            if ratio is None:
                likely = [name for name in self.names if "aspect" in name or "ratio" in name]
                ratio = self.find(likely, "", lambda v: isinstance(v, (int, float)))
            if len(flat(focal.value)) == 1 and ratio is not None and ratio.number() not in (0, 1):
                raise InputError(
                    f"has one focal length and {ratio.path}, which programs take as fy / fx or fx / fy; give "
                    "fx and fy"
                )
            if len(four) != 4 or four[0] < (_LEAST_FOCAL if size is None else _LEAST_SHARE * size[0]):
                raise InputError(
                    f"{focal.path} is not told to be in pixels; give a file with fx, fy, cx and cy in pixels"
                )
        skew = self.find(("skew", "s"), "", is_numbers)
        fx, fy, cx, cy = four
        return matrix_of(fx, fy, cx, cy, 0.0 if skew is None else skew.number())

    def _stated_model(self, side: str) -> str | None:
        """ROS's name of the distortion model that the file states; None if it states none."""
        stated: dict[str, str] = {}
        inner = self.find(COEFFICIENTS, side, lambda value: isinstance(value, dict) and "data" not in value)
        if inner is not None and (model := LooseKeys(inner)._stated_model("")) is not None:
            stated[model] = inner.path
        for names in (MODEL, KIND):
            for s in dict.fromkeys((side, "")):
                field = self.find(names, s, lambda value: isinstance(value, str))
                if field is None:
                    continue
                word = field.text()
                model = means(word) if word.strip() else "plumb_bob" if names is MODEL else None
                if names is MODEL and model is None:
                    model = "none" if plain(word) in ("none", "nodistortion") else word
                if model is not None:
                    stated.setdefault(model, field.text())
                    break
        for name in () if side and stated else FISHEYE:
            field = self.find((name,), "", lambda v: v in (0, 1, True, False, "true", "false", "0", "1"))
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

    def _distortion(self, side: str) -> Distortion:
        xi = self.find(("xi",), side, is_numbers)
        coefficients, named = self._coefficients(side)
        model = self._stated_model(side)
        if model in ("double_sphere", "eucm") and coefficients is None:
            found = [self.find((name,), side, is_numbers) for name in MODELS[model]]
            if any(found) and not all(found):
                raise InputError(
                    f"has not all of {', '.join(MODELS[model])}, the coefficients of {model}; add them"
                )
            if all(found):
                return Distortion(model, np.array([entry.number() for entry in found if entry]))
        if coefficients is None:
            self.lacks = model == UNKNOWN
            if xi is not None:
                raise InputError(
                    "has xi of an omnidirectional camera without its distortion; add D, or zeros"
                )
            return Distortion()
        self.coefficients_read = True
        if model == UNKNOWN:
            if coefficients.any():
                raise InputError(
                    "its distortion model is not known here; calibrate with OpenCV's model or its fisheye, "
                    "or with neurocal from the points"
                )
            return Distortion()
        if model == "none":
            if coefficients.any():
                raise InputError("states that there is no distortion, and has coefficients of it; remove one")
            return Distortion()
        if xi is not None:
            return _omnidirectional(xi, coefficients, "omnidir" if model is None else model)
        if model is None and self.distortion is not None:
            return _given(self.distortion, coefficients)
        if model is None and len(coefficients) == 4 and coefficients.any() and not named:
            raise InputError(
                "has four distortion coefficients, and does not say whether they are k1, k2, p1, p2 of an "
                "ordinary lens or k1 to k4 of a fisheye; convert it with --distortion k1k2p1p2 or fisheye"
            )
        return Distortion(*from_ros(model or "plumb_bob", coefficients))

    def _coefficients(self, side: str) -> tuple[Array | None, bool]:
        """Coefficients in OpenCV's order, and whether their names tell that p1 and p2 are among them."""
        field = self.find(COEFFICIENTS, side, lambda v: not isinstance(v, (str, int, float)))
        if field is not None:
            if isinstance(field.value, dict) and "data" not in field.value:
                inner = LooseKeys(field)
                found = inner._coefficients("")
                inner.refuse_unread(every=True)
                return found
            return matrix_data(field, -1), False
        radial, tangential = (self.find(names, side, is_numbers) for names in (RADIAL, TANGENTIAL))
        if radial is tangential is None and not side:  # mmpose and VoxelPose
            radial, tangential = (
                self.find((name,), "", counts)
                for name, counts in (("k", lambda v: _count(v) in (2, 3, 6)), ("p", lambda v: _count(v) == 2))
            )
        if radial is None and tangential is not None and any(flat(tangential.value)):
            tangential.refuse(f"has {tangential.path}, and no radial coefficients under a known name")
        if radial is not None:
            k = (
                matrix_data(radial, -1)
                if not isinstance(radial.value, (int, float))
                else np.array([radial.number()])
            )
            if tangential is None and radial.path.rpartition(".")[2] in ("k", "K"):
                radial.refuse("has k and no p; add p, the two tangential coefficients, or zeros")
            p = np.zeros(2) if tangential is None else matrix_data(tangential, 2)
            if len(k) not in (1, 2, 3, 6):
                radial.fail("2, 3 or 6 numbers")
            return np.array([*[*k, 0.0][:2], *p, *k[2:]]), True
        names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        values = {}
        for name in names:
            entry = self.find((name,), side, lambda v: is_numbers(v) and not isinstance(v, (list, dict)))
            if entry is not None:
                values[name] = entry.number()
        if not values:
            return None, False
        self.lacks = have_gap(values)
        if "k4" in values and not {"p1", "p2", "k5", "k6"} & set(values):  # as in a fisheye
            return np.array([values.get(f"k{n}", 0.0) for n in range(1, 5)]), False
        full = [values.get(name, 0.0) for name in names]
        return np.array(full if any(full[5:]) else full[:5]), True


def _count(value: Any) -> int:
    return len(flat(value)) if isinstance(value, list) else 0


def _omnidirectional(xi: Field, coefficients: Array, model: str) -> Distortion:
    """Distortion of OpenCV's omnidirectional camera, whose xi is a separate key."""
    value = xi.number() if isinstance(xi.value, (int, float)) else float(matrix_data(xi, 1)[0])
    coefficients = coefficients[:4] if not coefficients[4:].any() else coefficients
    if model != "omnidir" or len(coefficients) != 4:
        raise InputError(
            f"has xi of an omnidirectional camera, and {len(coefficients)} coefficients of the distortion "
            f"model {model[:40]!r}; give k1, k2, p1, p2, and omnidir or no model"
        )
    return Distortion("omnidir", np.array([value, *coefficients]))


def _given(model: str, coefficients: Array) -> Distortion:
    """Coefficients of the model that the caller names, in OpenCV's order."""
    names = MODELS[model]
    fewest = len(names) if model in WIDE else 0
    if len(coefficients) < fewest or coefficients[len(names) :].any():
        raise InputError(
            f"has {len(coefficients)} distortion coefficients, and {model} has {len(names)}; give another "
            "--distortion"
        )
    return Distortion(model, coefficients[: len(names)])
