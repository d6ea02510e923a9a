"""What holds on every processor: files are the same bytes on one machine, and the same answer on all.

Linear algebra adds in another order on another processor, so last digits differ. What is promised:

- The verdict, the distortion model, the outliers and whether it converged are the same, unless a decision is
  so close that the noise of the last digit decides it.
- From a CSV of points, every number that has a standard deviation is the same to 1e-5 of it.
- Points found in images, single precision inside, are the same to 1e-3 px, and calibrations from them to
  a twentieth of the standard deviation.
- Zoom lenses, whose networks end at a loss that is flat, are the same to a fifth of the standard deviation.

Measured on the sample data from SSE3 up to AVX-512: 2e-6, 2e-5 px, 0.006 and 0.05.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.places import SAMPLES
from support.slow_cases import slow_but

from neurocal_cli import read_points

FROM_POINTS = """
calibrate sample_data/points.csv --type 2 -o corner.yaml
calibrate sample_data/flat.csv -o flat.yaml
stereo sample_data/stereo_left.csv sample_data/stereo_right.csv --no-skew -o rig.yaml
"""
FROM_IMAGES = """
detect sample_data/board01.png sample_data/board02.png sample_data/board06.png \
  --cols 9 --rows 6 --square 25 -o board.csv
calibrate board.csv --no-skew -o board.yaml
"""
ZOOM = """
lens fit sample_data/zoom.csv --distortion none -o lens.yaml
lens camera lens.yaml --zoom 1250 --focus 400 -o wide.yaml
lens camera lens.yaml --zoom 2000 --focus 700 -o far.yaml
"""
NO_AVX512 = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR X86_V4"
# Kernels of OpenBLAS; what NumPy and OpenCV shall not use; what is needed, by NumPy's old and new names.
PROCESSORS = {
    "Prescott": (f"{NO_AVX512} X86_V3 AVX2 FMA3", "AVX512-SKX,AVX512-ICL,AVX2,FMA3,AVX", set()),
    "Haswell": (NO_AVX512, "AVX512-SKX,AVX512-ICL", {"AVX2", "X86_V3"}),
    "SkylakeX": ("", "", {"AVX512_SKX", "X86_V4"}),
}


def extensions() -> set[str]:
    """What NumPy makes use of on this processor."""
    found = np.show_config("dicts")["SIMD Extensions"]
    return {*found["baseline"], *found["found"]}


def run_commands(folder: Path, commands: str, processor: str = "") -> Path:
    """Run commands in a process that takes this processor for another one."""
    folder.mkdir()
    (folder / "sample_data").symlink_to(SAMPLES)
    environment = dict(os.environ)
    if processor:
        numpy_without, opencv_without, _ = PROCESSORS[processor]
        environment["OPENBLAS_CORETYPE"] = processor
        environment["NPY_DISABLE_CPU_FEATURES"] = numpy_without
        environment["OPENCV_CPU_DISABLE"] = opencv_without
    code = (
        "import sys; from neurocal_cli.commands import neurocal\n"
        "for line in sys.argv[1].split('\\n'): neurocal(line.split(), standalone_mode=False)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, commands.strip()],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_commands(tmp_path_factory.mktemp("processors") / "own", FROM_POINTS + FROM_IMAGES.lstrip())


@pytest.fixture(scope="module")
def zoom_reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_commands(tmp_path_factory.mktemp("processors") / "zoom", ZOOM)


@pytest.fixture(params=slow_but(("Prescott",), PROCESSORS))
def processor(request: pytest.FixtureRequest) -> str:
    needed = PROCESSORS[request.param][2]
    if platform.machine().lower() not in ("x86_64", "amd64"):
        pytest.skip("kernels are chosen by name on x86 only")
    if needed and not needed & extensions():
        pytest.skip(f"this processor has none of {', '.join(sorted(needed))}")
    return str(request.param)


def estimates(tree: object, place: str = "") -> Iterator[tuple[str, float, float]]:
    """Where, value and standard deviation of everything in a file that was estimated."""
    if isinstance(tree, dict):
        if tree.get("std"):
            yield place, tree["value"], tree["std"]
        tree = list(tree.items())
    elif isinstance(tree, list):
        tree = list(enumerate(tree))
    else:
        return
    for key, part in tree:
        yield from estimates(part, f"{place}/{key}")


def answers(tree: object, place: str = "") -> Iterator[tuple[str, object]]:
    """Everything in a file that is decided and not computed."""
    if isinstance(tree, dict):
        for key, part in tree.items():
            if key in ("distortion_model", "converged", "n_points", "n_rejected", "verdict"):
                yield f"{place}/{key}", part["word"] if key == "verdict" and isinstance(part, dict) else part
            else:
                yield from answers(part, f"{place}/{key}")


def assert_same_answer(mine: Path, theirs: Path, tolerance: float) -> None:
    one, other = (yaml.load(path.read_bytes(), yaml.CSafeLoader) for path in (mine, theirs))
    assert dict(answers(one)) == dict(answers(other))
    first, second = list(estimates(one)), list(estimates(other))
    assert [place for place, *_ in first] == [place for place, *_ in second] != []
    far = {
        place: abs(a - b) / std
        for (place, a, std), (_, b, _) in zip(first, second, strict=True)
        if abs(a - b) > tolerance * std
    }
    assert far == {}


def test_other_processors_give_the_same_answers(reference: Path, processor: str, tmp_path: Path) -> None:
    other = run_commands(tmp_path / processor, FROM_POINTS + FROM_IMAGES.lstrip(), processor)
    for name in ("corner", "flat", "rig"):
        assert_same_answer(reference / f"{name}.yaml", other / f"{name}.yaml", 1e-5)
    points, others = read_points(reference / "board.csv"), read_points(other / "board.csv")
    assert others.pixels == pytest.approx(points.pixels, abs=1e-3)
    assert_same_answer(reference / "board.yaml", other / "board.yaml", 0.05)


@pytest.mark.slow
def test_other_processors_give_the_same_zoom_lens(
    zoom_reference: Path, processor: str, tmp_path: Path
) -> None:
    other = run_commands(tmp_path / processor, ZOOM, processor)
    for name in ("wide", "far"):
        assert_same_answer(zoom_reference / f"{name}.yaml", other / f"{name}.yaml", 0.2)


@pytest.mark.slow
def test_the_same_processor_gives_the_same_bytes(reference: Path, tmp_path: Path) -> None:
    again = run_commands(tmp_path / "again", FROM_POINTS + FROM_IMAGES.lstrip())
    names = [path.name for path in reference.iterdir() if path.is_file()]
    assert len(names) == 5
    assert [name for name in names if (again / name).read_bytes() != (reference / name).read_bytes()] == []
