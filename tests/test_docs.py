"""README.md and docs/: what they show runs, is complete and links to something."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from consoles import PAGES, ROOT, agrees, blocks, prepare, run, run_page
from reference import pages

import neurocal_cli

README = (ROOT / "README.md").read_text(encoding="utf-8")
MANY_BLOCKS = [page for page in PAGES if any(blocks(page.read_text(encoding="utf-8")))]


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def test_the_first_two_blocks_are_one_command_each() -> None:
    first, second = re.findall(r"```(\w*)\n(.*?)```", README, flags=re.DOTALL)[:2]
    for language, text in (first, second):
        assert language == "sh"
        assert len(text.splitlines()) == 1
        assert text.startswith("python3 -m venv .venv && .venv/bin/pip install")
    assert "neurocal calibrate sample_data/points.csv --type 2" in first[1]
    assert "pytest" in second[1]


def test_the_readme_is_short_and_shows_a_picture() -> None:
    assert len(README.splitlines()) <= 200
    assert README.index("![") < README.index("```")


# The longest pages. README.md and the tutorial show the same commands.
SLOW_PAGES = {
    f"docs/how-to/{page}.md"
    for page in (
        "bad-calibration",
        "fisheye",
        "other-programs",
        "pipelines",
        "ros",
        "surveyed-points",
        "undistort",
        "zoom-lens",
    )
}


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name(page), marks=[pytest.mark.slow] * (name(page) in SLOW_PAGES))
        for page in MANY_BLOCKS
    ],
)
def test_what_a_page_shows_runs_and_prints_that(page: Path, tmp_path: Path) -> None:
    for shown, printed in run_page(page.read_text(encoding="utf-8"), tmp_path):
        assert agrees(shown.output, printed), (
            f"$ {shown.command}\n{printed}\n`python docs/tools/consoles.py` rewrites it"
        )


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        ("rms 0.363 px\n", "rms 0.364 px\n"),
        ("a  1.00\nb 20.0\n", "a 1.00\nb  19.97\n"),
        ("first\n...\n", "first\nsecond\n"),
        ("first\n...\nlast\n", "first\nsecond\nlast\n"),
        ("-0.0000 px\n", "+0.0000 px\n"),
        ("89 iterations, after 3 common steps\n", "100 iterations, after 5 common steps\n"),
        ("", ""),
    ],
)
def test_a_console_may_differ_by_rounding_and_by_lines_left_out(shown: str, printed: str) -> None:
    assert agrees(shown, printed)


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        ("rms 0.363 px\n", "rms 0.366 px\n"),
        ("first\n", "first\nsecond\n"),
        ("first\n...\nlast\n", "first\nlast\nsecond\n"),
        ("second\n...\n", "first\nsecond\n"),
        ("verdict: good\n", "verdict: poor\n"),
        ("12.0 px\n", "px 12.0\n"),
    ],
)
def test_a_console_may_not_differ_otherwise(shown: str, printed: str) -> None:
    assert not agrees(shown, printed)


def test_the_reference_pages_are_those_of_the_program() -> None:
    committed = {path: (ROOT / "docs" / path).read_text(encoding="utf-8") for path in pages()}
    assert committed == pages(), "run `python docs/tools/reference.py` and commit the result"


def test_each_command_has_a_page_and_is_in_the_menu_and_in_the_readme() -> None:
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    made = {path for path in pages() if path.startswith("commands/")}
    assert made == {name(path)[5:] for path in (ROOT / "docs" / "commands").glob("*.md")}
    for path in made:
        assert f" {path}\n" in menu
    for page in (ROOT / "man").glob("neurocal-*.1"):
        words = page.stem.replace("-", " ")
        assert f"commands/{page.stem.partition('-')[2]}.md" in made
        assert words in README


def test_each_public_name_is_in_the_python_reference() -> None:
    assert set(
        re.findall(r"^::: neurocal_cli\.(\w+)$", pages()["reference/api.md"], flags=re.MULTILINE)
    ) == set(neurocal_cli.__all__)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        assert target.startswith("http") or (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_files_of_the_project_that_a_page_names_are_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for path in re.findall(r"\b((?:neurocal_cli|tests|docs/tools)/[\w/]+\.py)", text):
        assert (ROOT / path).exists(), path


def test_the_architecture_page_is_of_this_package() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    package = ROOT / "neurocal_cli"
    layers = re.findall(r"`(\w+)`", text[text.index("| packages |") : text.index("Four rules")])
    there = {
        path.stem for path in package.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert set(layers) >= there - {"__init__", "__main__"}
    assert set(layers) - {"calibrate"} <= there
    way = re.findall(r"^\| `([\w/]+\.py)` \|", text, flags=re.MULTILINE)
    assert 1 < len(way) <= 8
    types = text[text.index("## Types one meets") : text.index("## One least-squares core")]
    modules = re.findall(r"^\| `[^|]+ \| `([\w.]+)` \| ", types, flags=re.MULTILINE)
    assert modules
    for path in (*way, *(module.replace(".", "/") + ".py" for module in modules)):
        assert (package / path).exists(), path


STAND_INS = """
cp sample_data/flat.csv points.csv
cp points.csv moved.csv
cp points.csv other_points.csv
neurocal calibrate points.csv --distortion k1 -o camera.yaml
cat > larger.py <<'END'
import cv2
for n in range(1, 7):
    image = cv2.imread(f"sample_data/board0{n}.png")
    image = cv2.copyMakeBorder(image, 90, 90, 120, 120, cv2.BORDER_REPLICATE)
    for name in (f"left0{n}.png", f"left0{n}.jpg", "frame.png"):
        cv2.imwrite(name, image)
END
python larger.py
echo 'planes: [{name: floor, cols: 9, rows: 6, square: 25.0}]' > corner.yaml
for side in left right; do
    for name in $side more_$side; do cp sample_data/stereo_$side.csv $name.csv; done
    neurocal calibrate $side.csv -o $side.yaml
done
neurocal stereo left.csv right.csv -o rig.yaml
cp sample_data/matches.csv matches.csv
neurocal lens fit sample_data/zoom.csv --distortion none -o lens.yaml
cat > cameras.csv <<'END'
zoom,alpha_u,alpha_v,u0,v0
24,1201,1200,960,541
35,1749,1748,961,540
50,2503,2499,962,540
70,3498,3497,963,538
END
"""


@pytest.mark.slow
def test_the_examples_of_the_help_run(tmp_path: Path) -> None:
    """In a folder that has files of the names that they use."""
    start = tmp_path / "start"
    start.mkdir()
    environment = prepare(start)
    made = run(["sh", "-euc", STAND_INS], start, environment)
    assert made.returncode == 0, made.stdout
    texts = [text.partition("## Examples")[2] for text in pages().values()]
    examples = dict.fromkeys(line for text in texts for line in text.splitlines() if "neurocal " in line)
    for number, example in enumerate(examples):
        folder = tmp_path / str(number)
        shutil.copytree(start, folder, symlinks=True)
        ended = run(["sh", "-euc", example], folder, environment)
        assert ended.returncode == 0, f"$ {example}\n{ended.stdout}"


def test_pictures_have_a_script() -> None:
    pictures = ROOT / "docs" / "pictures"
    scripts = "".join(path.read_text(encoding="utf-8") for path in pictures.glob("*.py"))
    for path in pictures.iterdir():
        if path.suffix in (".svg", ".png"):
            assert f'"{path.name}"' in scripts
            assert path.stat().st_size < 400_000


@pytest.mark.slow
def test_the_scripts_of_the_pictures_run(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "docs" / "pictures", tmp_path / "docs" / "pictures")
    (tmp_path / "sample_data").symlink_to(ROOT / "sample_data")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    for script in sorted((tmp_path / "docs" / "pictures").glob("*.py")):
        subprocess.run([sys.executable, script], check=True, env=environment)


def test_the_site_builds(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(tmp_path / "site")]
    subprocess.run(words, cwd=ROOT, check=True)
    assert (tmp_path / "site" / "commands" / "calibrate.html").exists()
