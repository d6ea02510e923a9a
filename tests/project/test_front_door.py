"""The public names: the same in both packages, each typed, and methods whose functions are there."""

from __future__ import annotations

import ast
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from inspect import isclass, isfunction, ismethod, signature
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import neurocal
import neurocal_cli
from neurocal_cli.calibration.calibrate import DISTORTIONS, CameraOptions, Lens, calibrate
from neurocal_cli.calibration.presented import Program
from neurocal_cli.camera.distortion import MODELS, Model
from neurocal_cli.camera.remapping import INTERPOLATIONS, Interpolation
from neurocal_cli.errors import InputError, NeurocalError, UsageError
from neurocal_cli.files.exchange.reading import FORMATS

ROOT = Path(neurocal_cli.__file__).parent


def test_both_packages_have_the_same_names() -> None:
    assert set(neurocal.__all__) == {*neurocal_cli.__all__, "__version__"}
    for name in neurocal.__all__:
        assert getattr(neurocal, name) is getattr(neurocal_cli, name)
        assert name in dir(neurocal)
    assert dir(neurocal_cli) == sorted(neurocal_cli.__all__)  # what a notebook completes
    with pytest.raises(AttributeError, match="module 'neurocal' has no attribute 'nothing'"):
        neurocal.nothing  # noqa: B018 - reading it is the test


def test_importing_it_loads_nothing_else() -> None:
    code = "import neurocal, sys; print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT.parent, capture_output=True, text=True)
    assert done.stdout.strip() == "False", done.stderr


def test_functions_that_methods_import_late_are_there() -> None:
    found = set()
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "late":
                found.add(tuple(a.value if isinstance(a, ast.Constant) else "" for a in node.args))
            elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "_summary":
                found.add(ast.literal_eval(node.value))
    found = {names for names in found if len(names) == 2}  # without the call that takes `_summary`
    assert len(found) >= 7
    for module, name in found:
        assert callable(getattr(import_module(f"neurocal_cli.{module}"), name))


def test_the_types_of_options_list_what_there_is() -> None:
    assert set(get_args(Model)) == set(MODELS)
    assert {name for part in get_args(Lens) for name in get_args(part)} == set(DISTORTIONS)
    assert set(get_args(Interpolation)) == set(INTERPOLATIONS)
    assert set(get_args(Program)) == set(FORMATS)


def test_options_of_rigs_are_those_of_a_camera() -> None:
    own = {"points", "camera_name", "progress", "start"}
    assert set(CameraOptions.__annotations__) == set(signature(calibrate).parameters) - own


# Annotations of what may be an array, whose functions say what is wrong with it.
ARRAYS = re.compile(r"ArrayLike|\| Array|tuple\[(int|float), |np.generic|\bAny$|Unpack")


def test_every_public_function_refuses_arguments_of_another_kind() -> None:
    count = 0
    for public in map(neurocal.__getattr__, neurocal_cli.__all__):
        names = ["", *(n for n in dir(public) if n == "__init__" or n[0] != "_")] if isclass(public) else [""]
        for function in [getattr(public, name) if name else public for name in names]:
            if not isfunction(function) and not ismethod(function):
                continue
            for parameter in signature(function).parameters.values():
                if parameter.name == "self" or ARRAYS.search(parameter.annotation):
                    continue
                count += 1
                with pytest.raises(NeurocalError, match=parameter.name):
                    function(**{parameter.name: object()})
    assert count > 350


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: neurocal.read_points(None), InputError, "paths must be a text or a path or a list"),
        (lambda: neurocal.read_board(True), InputError, "path must be a text or a path, not bool"),
        (lambda: neurocal.Board.single("9", 6, 25), UsageError, "cols must be a whole number, not '9'"),
        (
            lambda: neurocal.find_drift([1], 2),
            InputError,
            "old must be a Calibration or a Camera, not list of",
        ),
        (lambda: neurocal.fit_lens(None), InputError, "LensPoints, not NoneType; give what read_lens_points"),
        (lambda: neurocal.fit_lens(None, camera="fixed"), InputError, "points must be"),
        (
            lambda: neurocal.read_points("x.csv", notes=()),
            InputError,
            "notes must be a list, each a text, not",
        ),
        (
            lambda: neurocal.Correspondences(np.zeros((1, 3)), np.zeros((1, 2)), "left"),
            InputError,
            "view must be an array or a list, not 'left'",
        ),
        (lambda: neurocal.calibrate_rig({"a": 1}), InputError, "a dict with a Correspondences for each name"),
        (
            lambda: neurocal.calibrate(None, distortion="brown"),
            InputError,
            "points must be a Correspondences",
        ),
        (lambda: neurocal.calibrate(progress=3), InputError, "progress must be a function, not int"),
        (lambda: neurocal.plot(panel=3, kind="gif"), InputError, "panel must be a text, not int"),
        (lambda: neurocal.plot(kind="gif"), UsageError, "kind must be one of png, svg, pdf, not 'gif'"),
        (lambda: neurocal.Camera(np.eye(3)), InputError, "give what Intrinsics.from_matrix makes of a 3 x 3"),
    ],
)
def test_it_says_what_to_give(call: Callable[[], object], error: type[NeurocalError], words: str) -> None:
    with pytest.raises(error, match=re.escape(words)):
        call()


def test_lists_and_numbers_of_numpy_are_taken() -> None:
    pose = neurocal.Pose([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [1, 2, 3])
    assert pose.to_camera([[1, 1, 1]]).tolist() == [[2, 3, 4]]
    board = neurocal.Board.single(np.int64(9), np.float32(6), np.array(25))
    assert board == neurocal.Board.single(9, 6, 25.0)


def test_public_functions_are_pickled() -> None:
    assert pickle.loads(pickle.dumps(neurocal.calibrate)) is neurocal.calibrate


@pytest.mark.slow
def test_a_type_checker_sees_a_wrong_option(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        "import numpy as np\n"
        "from neurocal import Board, Correspondences, calibrate, calibrate_rig, calibrate_stereo\n"
        "from neurocal import detect_points\n"
        "found = detect_points(np.zeros((9, 9), np.uint8), Board.single(9, 6, 25.0))\n"
        "points = Correspondences.from_detections({'a': found})\n"
        "camera = calibrate(points, distortion='k1')\n"
        "text: str = camera.convert('kalibr').text\n"
        "calibrate(points, distortion='brown')\n"
        "camera.convert('brown')\n"
        "calibrate_stereo(points, points, skew=False, distortion='k1')\n"
        "calibrate_stereo(points, points, distortion='brown')\n"
        "calibrate_stereo(points, points, {'outliers': 'hide'})\n"
        "calibrate_rig({'a': points, 'b': points}, target='bent')\n"
    )
    words = [sys.executable, "-m", "mypy", "--strict", program]
    done = subprocess.run(words, cwd=ROOT.parent, capture_output=True, text=True)
    lines = [line for line in done.stdout.splitlines() if "error" in line]
    assert [line.split(":")[1] for line in lines if ": error" in line] == ["8", "9", "11", "12", "13"], (
        done.stdout
    )
