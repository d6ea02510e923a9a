"""Reports: whole pages that need nothing else, with the numbers of the result and true drawings."""

from __future__ import annotations

import hashlib
import re
from base64 import b64decode
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from support.command_line import refused, run, succeed
from support.made_calibration import made_calibration
from support.places import SAMPLES
from support.rigs import random_rig, sides

from neurocal_cli import write_calibration, write_points, write_rig
from neurocal_cli.calibration.calibration import Rejected, Verdict
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.calibration.verdict.evidence import Evidence
from neurocal_cli.commands.show.html_page import (
    board_shape,
    enlargement,
    error_bars,
    heat_map,
    residual_map,
)
from neurocal_cli.files.images import encode_png, parse_image
from neurocal_cli.files.result_files import write_result
from neurocal_cli.observations.target import Target

VOID = {"meta", "br"}


class Page(HTMLParser):
    """The elements of a page, its texts, and whether each element ends where it must."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.text = ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture
def camera_file(tmp_path: Path) -> Path:
    judged = Verdict("usable", ("few views < 5",), ("take more",), {"held_out_px": 0.4})
    write_calibration(replace(made_calibration(3), judgement=judged), tmp_path / "camera.yaml")
    return tmp_path / "camera.yaml"


def test_a_page_is_whole_and_loads_nothing(camera_file: Path, tmp_path: Path) -> None:
    result = run("report", camera_file, "-o", tmp_path / "report.html")
    assert (result.exit_code, result.stdout, result.stderr) == (0, "", "")
    text = (tmp_path / "report.html").read_text()
    page = Page(text)
    assert not {"link", "img", "iframe", "object"} & set(page.tags)
    assert [name for name, _ in page.attributes if name in ("src", "href", "onclick")] == []
    assert "http" not in text.replace("http-equiv", "")
    assert "default-src 'none'" in text
    assert page.tags.count("h1") == 1
    for shown in ("600.00", "view02", hashlib.sha256(camera_file.read_bytes()).hexdigest()):
        assert shown in page.text
    told = [page.text.index(word) for word in ("usable", "few views < 5", "take more", "Parameters")]
    assert told == sorted(told)


def test_no_text_of_a_file_can_become_html(tmp_path: Path) -> None:
    evil = '"<script>alert(1)</script>'
    calibration = made_calibration(2)
    judged = Verdict(evil, (evil,), (evil,), {"held_out_px": 0.4})
    points = calibration.points
    ids = np.array([f"{evil}{k}" for k in range(len(points))])
    views = {name: f"{evil} {name}" for name in points.view_names}
    labels = np.array([views[name] for name in points.view])
    rejected = Rejected(
        replace(points.select(slice(0, 3)), point=ids[:3], view=labels[:3]), np.ones(3), {evil: evil}
    )
    hostile = replace(
        calibration,
        points=replace(points, point=ids, view=labels, unit=evil),
        views={views[name]: view for name, view in calibration.views.items()},
        network=None,
        camera_name=evil,
        warnings=(evil,),
        stop_reason=evil,
        rejected=rejected,
        judgement=judged,
    )
    write_calibration(hostile, tmp_path / "evil.yaml")
    result = succeed("report", tmp_path / "evil.yaml")
    page = Page(result.stdout)
    assert page.tags.count("script") == 1
    assert page.text.count("alert(1)") > 10


def test_the_same_file_gives_the_same_page(camera_file: Path) -> None:
    assert run("report", camera_file).stdout == run("report", camera_file).stdout


def test_a_rig_has_a_page(tmp_path: Path) -> None:
    rig = calibrate_stereo(*sides(random_rig(np.random.default_rng(1), "verging", 4), 0.1), skew=False)
    write_rig(rig, tmp_path / "rig.yaml")
    result = succeed("report", tmp_path / "rig.yaml")
    page = Page(result.stdout)
    for shown in ("Calibration of 2 cameras", "R X_left", "Camera left", "Camera right", "neurocal stereo"):
        assert shown in page.text
    assert result.stdout.count('class="heat" transform') == 2


def test_a_lean_file_and_a_json_file_have_pages(tmp_path: Path) -> None:
    write_result(made_calibration(2), tmp_path / "lean.json", lean=True)
    result = succeed("report", tmp_path / "lean.json")
    assert "Residuals" not in Page(result.stdout).text


def photographs(folder: Path, names: tuple[str, ...], size: tuple[int, int] = (640, 480)) -> Path:
    """A noisy image for each name, which a JPEG file can hardly shorten."""
    folder.mkdir(exist_ok=True)
    grey = np.random.default_rng(0).integers(0, 256, (size[1], size[0]), np.uint8)
    data = encode_png(grey)
    for name in names:
        (folder / f"{name}.png").write_bytes(data)
    return folder


def test_photographs_are_shown_under_the_residuals_within_3_mb(tmp_path: Path) -> None:
    calibration = made_calibration(50)
    write_calibration(calibration, tmp_path / "camera.yaml")
    names = calibration.points.view_names
    folder = photographs(tmp_path / "images", names[1:])
    result = succeed("report", tmp_path / "camera.yaml", "--images", folder)
    assert result.stderr.startswith("note: no image of 1 views, such as view00, in ")
    assert len(result.stdout.encode()) < 3e6
    page = Page(result.stdout)
    assert page.tags.count("image") == 49
    links = [value for name, value in page.attributes if name in ("src", "href")]
    assert all(link.startswith("data:image/jpeg;base64,") for link in links)
    shown = parse_image(b64decode(links[0].partition(",")[2]))
    assert shown.size[0] / shown.size[1] == pytest.approx(640 / 480, rel=0.02)
    assert "img-src data:" in result.stdout


def test_photographs_of_another_camera_are_refused(camera_file: Path, tmp_path: Path) -> None:
    other = photographs(tmp_path / "other", ("view01",), (64, 48))
    result = run("report", camera_file, "--images", other)
    refused(result, "view01.png: has 64 x 48 px, but the camera 640 x 480; give the images")
    nobody = photographs(tmp_path / "nobody", ("a", "b"))
    result = run("report", camera_file, "--images", nobody)
    refused(result, "no image has the name of a view, such as view00")
    assert run("report", camera_file, "--images", other, "--images", other).exit_code == 2
    assert run("report", camera_file, *["--images", other] * 3).exit_code == 2


def test_points_left_out_are_crosses() -> None:
    drawn = residual_map(np.zeros((1, 2)), np.zeros((1, 2)), (640, 480), left_out=np.array([[50.0, 60.0]]))
    assert 'd="M43.6 53.6L56.4 66.4M43.6 66.4L56.4 53.6" class="out"' in drawn


def test_calibrate_makes_the_page_in_the_same_run_and_tells_how(tmp_path: Path) -> None:
    write_points(made_calibration(3).points, tmp_path / "my points.csv")
    words = ["calibrate", tmp_path / "my points.csv", "--no-skew", "-o", tmp_path / "camera.yaml"]
    result = succeed(*words, "--html", tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text())
    typed = (
        f"neurocal calibrate '{tmp_path / 'my points.csv'}' --no-skew -o {tmp_path / 'camera.yaml'} --html"
    )
    assert typed in page.text
    assert hashlib.sha256((tmp_path / "my points.csv").read_bytes()).hexdigest() in page.text
    assert f"numpy {np.__version__}" in page.text
    before = (tmp_path / "camera.yaml").read_bytes()
    succeed(*words)
    assert (tmp_path / "camera.yaml").read_bytes() == before
    same = run("report", tmp_path / "camera.yaml").stdout
    assert (
        same.split("How to repeat it")[0] == (tmp_path / "page.html").read_text().split("How to repeat it")[0]
    )
    result = run(*words, "--html", tmp_path / "camera.yaml")
    assert result.exit_code == 2
    result = run(*words[:-2], "--html", tmp_path / "my points.csv")
    assert result.exit_code == 2
    assert "is an input and would be overwritten" in result.stderr


def test_stereo_makes_the_page_in_the_same_run(tmp_path: Path) -> None:
    left, right = sides(random_rig(np.random.default_rng(1), "verging", 4), 0.1)
    write_points(left, tmp_path / "l.csv")
    write_points(right, tmp_path / "r.csv")
    words = ["stereo", tmp_path / "l.csv", tmp_path / "r.csv", "--no-skew", "-o", tmp_path / "rig.yaml"]
    result = succeed(*words, "--html", tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text())
    for name in ("l.csv", "r.csv"):
        assert hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() in page.text
    lefts, rights = (photographs(tmp_path / side, one.view_names, one.image_size or (0, 0))
                     for side, one in (("left", left), ("right", right)))  # fmt: skip
    result = succeed("report", tmp_path / "rig.yaml", "--images", lefts, "--images", rights)
    assert Page(result.stdout).tags.count("image") == left.n_views + right.n_views
    result = run("report", tmp_path / "rig.yaml", *["--images", lefts] * 3)
    assert (result.exit_code, result.stdout) == (2, "")
    assert "the file is of 2 cameras; give --images once, or for each" in result.stderr


def test_fifty_views_are_less_than_3_mb(tmp_path: Path) -> None:
    write_calibration(made_calibration(50), tmp_path / "camera.yaml")
    result = run("report", tmp_path / "camera.yaml")
    assert len(result.stdout.encode()) < 3e6
    assert Page(result.stdout).tags.count("figure") == 54


def test_residuals_are_drawn_where_and_as_long_as_they_are() -> None:
    pixels, residuals = np.array([[100.0, 50.0], [200.0, 80.0]]), np.array([[0.5, -0.25], [-0.1, 0.2]])
    drawn = residual_map(pixels, residuals, (640, 480), 40.0)
    numbers = re.findall(r"M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)", drawn)
    found = np.array(numbers, dtype=float)
    assert np.abs(found[:, :2] - pixels).max() < 0.06
    assert np.abs(found[:, 2:] - found[:, :2] - 40 * residuals).max() < 0.11
    scale = enlargement(residuals, (640, 480))
    assert str(scale)[0] in "125"
    assert 0.015 * 640 < 3 * scale * np.sqrt(np.mean((residuals**2).sum(axis=1))) <= 0.04 * 640


def test_the_map_has_each_value_where_it_is_and_none_where_there_is_none() -> None:
    values = 0.1 * 2.0 ** (np.tile(np.arange(9), (5, 1)) / 2)  # 0.1 to 1.6 from left to right
    values[:3, :3] = np.nan
    drawn = heat_map(values, (640, 480), np.array([[5.0, 6.0]]), "px", "a map")
    columns, covered = -(-120 // 8) * 8, 0
    for path, opacity, low, high in re.findall(
        r'<path d="([^"]*)" fill-opacity="([\d.]+)"><title>([\d.]+) to ([\d.]+) px', drawn
    ):
        cells = [[int(n) for n in c] for c in re.findall(r"M(\d+) (\d+)h(\d+)v1h-\d+z", path)]
        covered += sum(length for _, _, length in cells)
        for column, row, length in cells:
            place = 8 * np.array([column + 0.5, column + length - 0.5]) / columns
            shown = 0.1 * 2 ** (place / 2)
            assert 0.95 * float(low) <= shown[0] <= shown[1] <= 1.05 * float(high)  # of two digits
            assert column >= 3 * columns / 8 or row >= 2 * 15
        assert 0 < float(opacity) < 1
    assert covered == columns * 60 - 45 * 45  # the empty corner reaches to the next places
    assert "M5 6h0" in drawn
    assert heat_map(np.full((2, 2), np.nan), (640, 480), np.zeros((0, 2)), "px", "a map") == ""


def test_the_page_shows_how_uncertain_the_camera_is(tmp_path: Path) -> None:
    calibration = made_calibration(3)
    write_calibration(calibration, tmp_path / "camera.yaml")
    found = Evidence(calibration).projection
    assert found is not None
    page = run("report", tmp_path / "camera.yaml").stdout
    assert f"middle distance; {found.worst:.3g} px at most" in page
    assert page.count('class="heat" transform') == 1
    points = replace(calibration.points, image_size=None)
    write_calibration(replace(calibration, points=points), tmp_path / "unknown.yaml")
    assert "projected pixel" not in run("report", tmp_path / "unknown.yaml").stdout


def test_bars_are_as_high_as_the_errors() -> None:
    drawn = error_bars(["a", "b<"], [0.1, 0.4], 0.3)
    heights = [float(h) for h in re.findall(r'height="([\d.]+)" class="bar"', drawn)]
    assert heights[1] / heights[0] == pytest.approx(4, rel=0.01)
    assert "b&lt;: 0.4 px" in drawn
    assert re.findall(r'text-anchor="end">([\d.]+)<', drawn) == ["0", "0.1", "0.2", "0.3", "0.4", "0.5"]
    assert re.findall(r'text-anchor="middle">(\d+)<', drawn) == ["1", "2"]


def test_the_discs_of_a_board_are_as_large_as_its_heights() -> None:
    places = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0]])
    drawn = board_shape(places, np.array([0.1, -0.4, 0.2, 0.0]))
    found = re.findall(r'cx="(\d+)" cy="(\d+)" r="([\d.]+)" class="(up|down)"', drawn)
    assert [(int(x), int(y)) for x, y, _, _ in found] == [(0, 0), (10, 0), (0, 10), (10, 10)]
    areas = np.array([float(radius) for _, _, radius, _ in found]) ** 2
    assert areas / areas[1] == pytest.approx([0.25, 1.0, 0.5, 0.0], abs=0.01)
    assert [side for *_, side in found] == ["up", "down", "up", "down"]
    assert board_shape(places, np.zeros(4)) == ""


def test_the_page_shows_the_board_as_it_was_found_and_the_lenses_tried(tmp_path: Path) -> None:
    calibration = made_calibration(3)
    world = np.unique(calibration.points.world, axis=0)
    world = world[world[:, 2] == 0]
    bent = np.column_stack([np.zeros((len(world), 2)), 1e-5 * world[:, 0] ** 2])
    target = Target(world, world + bent, np.full_like(world, 0.01), np.zeros(len(world), int), {}, False, 9.0)
    tried = {"k1": 0.2, calibration.distortion_model: 0.1}
    write_calibration(replace(calibration, target=target, lens_choice=tried), tmp_path / "camera.yaml")
    page = Page(run("report", tmp_path / "camera.yaml").stdout)
    assert "target: bent by" in page.text
    assert page.tags.count("circle") == len(world) + 1
    assert page.text.index("0.1000") < page.text.index("chosen") < page.text.index("0.2000")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\n", "has no neurocal block"),
        ("- 1\n", "is not a calibration"),
        ("X,Y\n", "is not a calibration"),
    ],
)
def test_another_file_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text(text)
    result = run("report", tmp_path / "file", "-o", tmp_path / "r.html")
    refused(result, message)
    assert not (tmp_path / "r.html").exists()


@pytest.mark.slow
def test_a_zoom_lens_has_a_page(tmp_path: Path) -> None:
    zoom = SAMPLES / "zoom.csv"
    succeed("lens", "fit", zoom, "-o", tmp_path / "lens.yaml")
    result = succeed("report", tmp_path / "lens.yaml")
    assert "Calibration of a zoom lens" in Page(result.stdout).text
    assert (
        "zoom from 0 to 3000 from left to right and focus from 0 to 900 from top to bottom" in result.stdout
    )
