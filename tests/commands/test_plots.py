"""Pictures are drawn for whatever calibration, the same for the same one."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from support.command_line import run, succeed
from support.made_calibration import made_calibration
from support.rigs import random_rig, sides
from support.slow_cases import slow_but

from neurocal_cli import NeurocalError, write_calibration, write_points
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.calibration.rig.evaluation import evaluate_stereo, evaluate_stereo_rig
from neurocal_cli.calibration.rig.rig import StereoRig
from neurocal_cli.commands.show import CAMERA_PANELS, SPACE_PANELS, plot_pages
from neurocal_cli.commands.show.camera_panels import Subject
from neurocal_cli.commands.show.figure import drawing
from neurocal_cli.commands.show.plot_pages import draw_camera, draw_points_in_space, draw_stereo

BEGINNINGS = {"png": b"\x89PNG\r\n", "pdf": b"%PDF", "svg": b"<?xml"}


@pytest.mark.parametrize("kind", slow_but(("svg", "pdf"), BEGINNINGS))
def test_the_same_calibration_gives_the_same_picture(kind: str) -> None:
    picture = draw_camera(Subject.of(made_calibration(2)), kind, "views")
    assert picture.startswith(BEGINNINGS[kind])
    assert draw_camera(Subject.of(made_calibration(2)), kind, "views") == picture


@pytest.mark.parametrize(
    "calibration",
    [
        pytest.param(made_calibration(1, noise=0), id="without noise", marks=pytest.mark.slow),
        pytest.param(made_calibration(45), id="many views", marks=pytest.mark.slow),
        pytest.param(
            replace(
                made_calibration(),
                network=None,
                camera_name="$x_1$ \n",
                points=replace(made_calibration().points, image_size=None),
            ),
            id="no network, no image size",
        ),
    ],
)
def test_odd_calibrations_are_drawn(calibration: Calibration) -> None:
    assert draw_camera(Subject.of(calibration)).startswith(BEGINNINGS["png"])


def test_missing_matplotlib_is_said_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(NeurocalError, match="pip install matplotlib"):
        draw_camera(Subject.of(made_calibration()))


@pytest.mark.slow
def test_drawing_leaves_the_state_of_pyplot_alone() -> None:
    code = (
        "import sys; from support.made_calibration import made_calibration;"
        "from neurocal_cli.commands.show.plot_pages import Subject, draw_camera;"
        "draw_camera(Subject.of(made_calibration()));"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, check=True)


@pytest.mark.parametrize("panel", slow_but(("uncertainty",), CAMERA_PANELS))
def test_each_panel_of_a_camera_is_a_picture(panel: str) -> None:
    assert draw_camera(Subject.of(made_calibration(3)), "svg", panel).startswith(BEGINNINGS["svg"])


def test_a_camera_without_a_calibration_is_drawn_with_the_points_it_was_judged_by() -> None:
    cal = made_calibration(2)
    subject = Subject.of(cal.camera, cal.points)
    assert subject.calibration is None
    assert b"known only of a calibration" in draw_camera(subject, "svg", "uncertainty").replace(
        b"&#x20;", b" "
    )
    assert draw_camera(subject, "png", "residuals").startswith(BEGINNINGS["png"])


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    return calibrate_stereo(*sides(random_rig(np.random.default_rng(1), "verging", 4), 0.1), skew=False)


@pytest.mark.parametrize("panel", slow_but(("poses",), (None, *CAMERA_PANELS)))
def test_a_rig_is_drawn(rig: StereoRig, panel: str | None) -> None:
    assert draw_stereo(rig, "png", panel).startswith(BEGINNINGS["png"])


@pytest.mark.parametrize("page", slow_but(("upright images",), ["upright images", "a rig"]))
def test_no_title_of_a_page_is_cut_off(monkeypatch: pytest.MonkeyPatch, rig: StereoRig, page: str) -> None:
    drawn = []

    @contextmanager
    def kept(*how: Any) -> Iterator[tuple[Figure, BytesIO]]:
        with drawing(*how) as (figure, file):
            drawn.append(figure)
            yield figure, file

    monkeypatch.setattr(plot_pages, "drawing", kept)
    if page == "a rig":
        draw_stereo(rig)
    else:
        cal = made_calibration(3)
        draw_camera(Subject.of(replace(cal, points=replace(cal.points, image_size=(640, 1280)))))
    (figure,) = drawn
    figure.draw_without_rendering()  # at its own resolution, not that of the file
    whole = figure.get_window_extent()
    words = {
        word
        for axes in figure.findobj(Axes)
        for word in (axes.get_xlabel(), axes.get_ylabel(), axes.get_title(loc="left"))
    }
    texts = [text for text in figure.findobj(Text) if text.get_text() in words - {""}]
    assert len(texts) > 15
    for text in texts:
        box = text.get_window_extent()
        assert whole.x0 <= box.x0 < box.x1 <= whole.x1, text
        assert whole.y0 <= box.y0 < box.y1 <= whole.y1, text


@pytest.mark.parametrize("panel", slow_but((None,), (None, *SPACE_PANELS)))
def test_points_in_space_are_drawn(rig: StereoRig, panel: str | None) -> None:
    evaluation = evaluate_stereo_rig(rig)
    assert draw_points_in_space(evaluation, rig, "png", panel).startswith(BEGINNINGS["png"])


def test_points_in_space_are_drawn_without_a_rig(rig: StereoRig) -> None:
    evaluation = evaluate_stereo(rig.left, rig.right)
    assert draw_points_in_space(evaluation, None, "png", "depths").startswith(BEGINNINGS["png"])


def test_the_commands_draw_a_page_and_single_panels(tmp_path: Path) -> None:
    cal = made_calibration(3)
    write_points(cal.points, tmp_path / "points.csv")
    write_calibration(cal, tmp_path / "camera.yaml")
    words = ["evaluate", "camera", tmp_path / "camera.yaml"]
    result = succeed(*words, "--plot", tmp_path / "page.png", "--plot", f"views={tmp_path / 'views.pdf'}")
    assert (tmp_path / "page.png").read_bytes().startswith(BEGINNINGS["png"])
    assert (tmp_path / "views.pdf").read_bytes().startswith(BEGINNINGS["pdf"])
    assert len((tmp_path / "page.png").read_bytes()) > 3 * len((tmp_path / "views.pdf").read_bytes())
    for name, message in (
        (f"views={tmp_path / 'points.txt'}", "not a picture file"),
        (tmp_path / "camera.yaml", "not a picture file"),
        (tmp_path / "no" / "views.png", "no"),
    ):
        result = run(*words, "--plot", name)
        assert result.exit_code in (1, 2)
        assert message in result.stderr
    same = ["--plot", tmp_path / "a.png", "--plot", f"views={tmp_path / 'a.png'}"]
    assert run("calibrate", tmp_path / "points.csv", *same).exit_code == 2
    assert not (tmp_path / "a.png").exists()


def test_a_panel_that_does_not_exist_is_no_part_of_a_file_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run("evaluate", "camera", "camera.yaml", "--plot", "pose=x.png")
    assert result.exit_code == 2
    assert "there is no panel 'pose'; choose from residuals, " in result.stderr
