"""Who may import what: the library knows no command line, and one package opens files."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
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
    "matplotlib": ("commands/show/",),
    "yaml": ("files/",),
    "distributed": ("commands/cluster.py",),
    "dask": ("commands/cluster.py",),
    "cv2": (
        "calibration/other_methods/calibrate_by.py",
        "camera/remapping.py",
        "detection/",
        "files/board_pictures.py",
        "files/images.py",
        "observations/markers.py",
        "simulation/",
    ),
}
# The rooms from the ground up: each imports from itself and from those before it only.
ROOMS = (
    "errors",
    "camera",
    "observations",
    "adjustment",
    "network",
    "calibration",
    "files",
    "simulation",
    "detection",
    "commands",
    "__main__",
)
METHODS = {"read_text", "read_bytes", "write_text", "write_bytes", "open"}
NUMPY_FILES = {"load", "save", "savez", "savetxt", "loadtxt", "genfromtxt", "fromfile", "tofile"}

# What runs later, if ever: functions, and what only type checkers read.
DEFERRED = (ast.FunctionDef, ast.If)


@cache
def tree_of(name: str) -> ast.Module:
    return ast.parse((ROOT / name).read_text("utf-8"))


@cache
def nodes_of(name: str) -> tuple[ast.AST, ...]:
    """What imports something, wherever in a module it stands."""
    return tuple(n for n in statements(tree_of(name)) if isinstance(n, (ast.Import, ast.ImportFrom)))


def statements(tree: ast.AST) -> Iterator[ast.AST]:
    """All statements, those inside others too; their expressions, which import nothing, take long."""
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):
        for node in getattr(tree, part, ()):
            yield node
            yield from statements(node)


def naming(names: list[str], words: Iterable[str]) -> list[str]:
    """The modules in which any of these words stands."""
    return [name for name in names if any(word in (ROOT / name).read_text("utf-8") for word in words)]


@cache
def imports(name: str) -> frozenset[str]:
    """What a module imports anywhere."""
    return frozenset(imported(nodes_of(name)))


def imported(nodes: Iterable[ast.AST]) -> Iterator[str]:
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


def modules_of(name: str) -> set[str]:
    """What is imported, with each name that may be a module itself."""
    named = [node for node in nodes_of(name) if isinstance(node, ast.ImportFrom)]
    return {*imports(name), *(f"{node.module}.{alias.name}" for node in named for alias in node.names)}


@cache
def calls(name: str) -> frozenset[tuple[str, str]]:
    """Object (``""`` for a plain name) and name of everything that is called."""
    return frozenset(called(ast.walk(tree_of(name))))


def called(nodes: Iterable[ast.AST]) -> Iterator[tuple[str, str]]:
    for node in nodes:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            yield "", node.func.id
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            yield ast.unparse(node.func.value), node.func.attr


def room(name: str) -> str:
    return name.split("/")[0].removesuffix(".py")


def rooms_used(name: str) -> set[str]:
    """The rooms that a module imports from, without the top of the package."""
    return {m.split(".")[1] for m in imports(name) if m.startswith("neurocal_cli.")}


def test_a_module_imports_from_its_own_room_and_from_those_below() -> None:
    level = {one: k for k, one in enumerate(ROOMS)}
    wrong = {
        name: above
        for name in set(NAMES) - {"__init__.py"}
        if (above := {used for used in rooms_used(name) if level[used] > level[room(name)]})
    }
    assert wrong == {}


def test_nothing_stands_at_the_top_but_the_rooms_the_errors_and_the_entry() -> None:
    files = {path.name for path in ROOT.iterdir() if path.is_file()}
    assert files == {"__init__.py", "__main__.py", "errors.py", "py.typed"}
    folders = {path.name for path in ROOT.iterdir() if (path / "__init__.py").exists()}
    assert folders == set(ROOMS) - {"errors", "__main__"}
    assert len(folders) == 9


def test_the_architecture_page_lists_the_rooms_in_this_order_with_what_they_may_import() -> None:
    page = (ROOT.parent / "docs" / "development" / "architecture.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\w+)` \|.*\| ([^|]*) \|$", page, flags=re.MULTILINE)
    assert [name for name, _ in rows[:9]] == list(ROOMS[1:-1])
    for name, allowed in rows[:9]:
        used = set().union(*(rooms_used(one) for one in NAMES if room(one) == name))
        assert used - {name, "errors"} == set(re.findall(r"`(\w+)`", allowed)), name


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Neither at once nor in functions: each module can be understood before those that use it."""
    rest = {name.removesuffix(".py").removesuffix("/__init__").replace("/", "."): name for name in NAMES}
    rest = {f"neurocal_cli.{module}": name for module, name in rest.items() if module != "__init__"}
    used = {module: modules_of(name) & rest.keys() - {module} for module, name in rest.items()}
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
        name
        for name, tree in at_once.items()
        if "scipy" in {m.split(".")[0] for m in imported(statements(tree))}
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
    assert "calibration.calibrate" in loaded, done.stderr
    assert not loaded & {
        "adjustment.board.posterior",
        "adjustment.open_choices",
        "calibration.lens_choice.candidate_models",
        "calibration.outlier_rejection",
        "calibration.target_choice",
        "camera.nearest_camera",
    }


def test_the_library_does_not_import_the_commands() -> None:
    """The front door names the page and the pictures of results, and loads them when they are asked for."""
    users = [name for name in LIBRARY if any(m.startswith("neurocal_cli.commands") for m in imports(name))]
    assert users == ["__init__.py"]
    at_once = imported(node for node in tree_of("__init__.py").body if not isinstance(node, DEFERRED))
    assert not any(module.startswith("neurocal_cli") for module in at_once)


def test_only_files_opens_files() -> None:
    users = {
        name
        for name in naming(NAMES, METHODS | NUMPY_FILES)
        for owner, function in calls(name)
        if (function in METHODS if owner else function == "open")
        or (owner == "np" and function in NUMPY_FILES)
    }
    assert {name for name in users if not name.startswith("files/")} == set()


def test_the_library_neither_prints_nor_exits() -> None:
    forbidden = {("", "print"), ("", "input"), ("", "exit"), ("sys", "exit"), ("os", "_exit")}
    suspects = naming(LIBRARY, {function for _, function in forbidden})
    assert [name for name in suspects if not forbidden.isdisjoint(calls(name))] == []


def test_a_module_says_what_it_is_for() -> None:
    assert [name for name in NAMES if not ast.get_docstring(tree_of(name))] == []
    vague = {"utils", "helpers", "manager"}
    assert [name for name in NAMES if vague & set(Path(name).with_suffix("").parts)] == []


def test_the_tests_that_comments_name_are_there() -> None:
    tests = {path.name for path in (ROOT.parent / "tests").rglob("test_*.py")}
    named = {name: set(re.findall(r"\btest_\w+\.py", (ROOT / name).read_text("utf-8"))) for name in NAMES}
    assert {name: gone for name, those in named.items() if (gone := those - tests)} == {}
