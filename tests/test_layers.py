"""Who may import what: the library knows no command line, and one package opens files."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import neurocal_cli

ROOT = Path(neurocal_cli.__file__).parent
NAMES = [str(path.relative_to(ROOT)) for path in ROOT.rglob("*.py")]
LIBRARY = [name for name in NAMES if not name.startswith("commands/") and name != "__main__.py"]

# Which modules may import a package, by the beginning of their path.
HOMES = {
    "click": ("commands/",),
    "rich": ("commands/",),
    "matplotlib": (
        "plots/",
        "target_plot.py",
        "simulation/plots.py",
        "planning/plots.py",
        "zoom_lens/plots.py",
    ),
    "yaml": ("io/",),
    "cv2": (
        "baselines/opencv.py",
        "detection/",
        "simulation/",
        "io/images.py",
        "io/video.py",
        "io/board_pictures.py",
        "distortion/remapping.py",
    ),
}
# Rooms, a folder or a module each, from the ground up: each imports from itself and from lower levels only.
LEVELS = (
    {"errors", "frozen_dataclass", "geometry"},
    {"distances", "given_values", "processes"},
    {"bends", "board", "camera", "least_squares", "median", "network", "planes", "points"},
    {"target"},
    {"calibration", "printing", "training"},
    {"bundle_adjustment"},
    {"target_shape"},
    {"verdict", "distortion", "initialisation"},
    {"pipeline"},
    {"baselines"},
    {"methods"},
    {"evaluation"},
    {"report"},
    {"stereo"},
    {"comparison"},
    {"plots"},
    {"target_plot"},
    {"zoom_lens"},
    {"html_report", "planning"},
    {"simulation"},
    {"io"},
    {"detection"},
    {"commands"},
    {"__main__"},
)
METHODS = {"read_text", "read_bytes", "write_text", "write_bytes", "open"}
NUMPY_FILES = {"load", "save", "savez", "savetxt", "loadtxt", "genfromtxt", "fromfile", "tofile"}

# What runs later, if ever: functions, and what only type checkers read.
DEFERRED = (ast.FunctionDef, ast.If)


@cache
def tree_of(name: str) -> ast.Module:
    return ast.parse((ROOT / name).read_text("utf-8"))


@cache
def imports(name: str) -> frozenset[str]:
    """What a module imports anywhere."""
    return frozenset(imported(tree_of(name)))


def imported(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


def modules_of(tree: ast.Module) -> set[str]:
    """What is imported, with each name that may be a module itself."""
    named = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    return {*imported(tree), *(f"{node.module}.{alias.name}" for node in named for alias in node.names)}


def calls(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Object (``""`` for a plain name) and name of everything that is called."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            yield "", node.func.id
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            yield ast.unparse(node.func.value), node.func.attr


def room(name: str) -> str:
    return name.split("/")[0].removesuffix(".py")


def test_a_module_imports_from_its_own_room_and_from_below() -> None:
    wrong = {}
    for name in set(NAMES) - {"__init__.py"}:
        mine = room(name)
        (level,) = (k for k, rooms in enumerate(LEVELS) if mine in rooms)
        used = {m.split(".")[1] for m in imports(name) if m.startswith("neurocal_cli.")}
        wrong[name] = used - set().union({mine}, *LEVELS[:level])
    assert {name: rooms for name, rooms in wrong.items() if rooms} == {}


def test_the_architecture_page_lists_all_rooms_in_this_order() -> None:
    page = (ROOT.parent / "docs" / "architecture.md").read_text("utf-8")
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    rooms = {mine for level in LEVELS for mine in level} - {"__main__"}
    table = [set(re.findall(r"`(\w+)`", row)) & rooms for row in rows[: len(LEVELS)]]
    place = {mine: k for k, row in reversed(list(enumerate(table))) for mine in row}
    assert set(place) == rooms
    height = {mine: k for k, level in enumerate(LEVELS) for mine in level}
    for name in set(NAMES) - {"__init__.py", "__main__.py"}:
        for used in {m.split(".")[1] for m in imports(name) if m.startswith("neurocal_cli.")} & rooms:
            assert place[used] <= place[room(name)], (room(name), used)
            assert height[used] <= height[room(name)]


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Neither at once nor in functions: each module can be understood before those that use it."""
    rest = {name.removesuffix(".py").removesuffix("/__init__").replace("/", "."): name for name in NAMES}
    rest = {f"neurocal_cli.{module}": name for module, name in rest.items() if module != "__init__"}
    used = {module: modules_of(tree_of(name)) & rest.keys() - {module} for module, name in rest.items()}
    while ends := [module for module in used if not used[module] & used.keys()]:
        for module in ends:
            del used[module]
    assert used == {}


@pytest.mark.parametrize("package", HOMES)
def test_a_package_is_imported_only_where_it_belongs(package: str) -> None:
    users = [name for name in NAMES if package in {m.split(".")[0] for m in imports(name)}]
    assert [name for name in users if not name.startswith(HOMES[package])] == []


def test_scipy_is_imported_inside_the_functions_that_use_it() -> None:
    """Loading it takes longer than a calibration."""
    at_once = {
        name: ast.Module([node for node in tree_of(name).body if not isinstance(node, DEFERRED)], [])
        for name in NAMES
    }
    assert [
        name for name, tree in at_once.items() if "scipy" in {m.split(".")[0] for m in imported(tree)}
    ] == []


def test_a_calibration_imports_nothing_that_it_is_not_asked_for() -> None:
    """A module takes a fifth of a millisecond, and a calibration of 13 views ten."""
    code = (
        "import sys; from neurocal_cli import calibrate, read_points;"
        "calibrate(read_points('sample_data/flat.csv'), distortion='k1', outliers='keep', target='given');"
        "print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT.parent, capture_output=True, text=True)
    loaded = {m.removeprefix("neurocal_cli.") for m in done.stdout.split() if m.startswith("neurocal_cli.")}
    assert "methods" in loaded, done.stderr
    assert not loaded & {
        "bundle_adjustment.open_coefficients",
        "distortion.candidate_models",
        "distortion.similar_lens",
        "initialisation.random_cameras",
        "pipeline.outlier_rejection",
        "pipeline.target_choice",
        "target_shape.posterior",
    }


def test_the_library_does_not_import_the_commands() -> None:
    users = [name for name in LIBRARY if any(m.startswith("neurocal_cli.commands") for m in imports(name))]
    assert users == []


def test_only_io_opens_files() -> None:
    users = {
        name
        for name in NAMES
        for owner, called in calls(tree_of(name))
        if (called in METHODS if owner else called == "open") or (owner == "np" and called in NUMPY_FILES)
    }
    assert {name for name in users if not name.startswith("io/")} == set()


def test_the_library_neither_prints_nor_exits() -> None:
    forbidden = {("", "print"), ("", "input"), ("", "exit"), ("sys", "exit"), ("os", "_exit")}
    assert [name for name in LIBRARY if not forbidden.isdisjoint(calls(tree_of(name)))] == []


def test_a_module_says_what_it_is_for() -> None:
    assert [name for name in NAMES if not ast.get_docstring(tree_of(name))] == []
    vague = {"utils", "helpers", "manager"}
    assert [name for name in NAMES if vague & set(Path(name).with_suffix("").parts)] == []
