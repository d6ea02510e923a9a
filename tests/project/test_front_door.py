"""The public names: the same in both packages, each typed, and methods whose functions are there."""

from __future__ import annotations

import ast
import subprocess
import sys
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import get_args

import pytest

import neurocal
import neurocal_cli
from neurocal_cli.calibration.calibrate import DISTORTIONS, CameraOptions, Lens, calibrate
from neurocal_cli.calibration.presented import Program
from neurocal_cli.camera.distortion import MODELS, Model
from neurocal_cli.camera.remapping import INTERPOLATIONS, Interpolation
from neurocal_cli.files.exchange.reading import FORMATS

ROOT = Path(neurocal_cli.__file__).parent


def test_both_packages_have_the_same_names() -> None:
    assert set(neurocal.__all__) == {*neurocal_cli.__all__, "__version__"}
    for name in neurocal.__all__:
        assert getattr(neurocal, name) is getattr(neurocal_cli, name)
        assert name in dir(neurocal)
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
