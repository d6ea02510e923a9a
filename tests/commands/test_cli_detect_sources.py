"""Images that were seen before, videos, and folders that grow."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.command_line import refused, run, succeed
from support.places import SAMPLES
from support.slow_cases import slow_but

from neurocal_cli.commands import frames
from neurocal_cli.detection import batch
from neurocal_cli.detection.batch import choose_frames
from neurocal_cli.files.points_csv import read_points

BOARD = ("--cols", 9, "--rows", 6, "--square", 25)
IMAGES = tuple(SAMPLES / f"board0{k}.png" for k in (1, 2, 3))


@pytest.fixture
def looked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The images that were really examined, by their names."""
    seen: list[str] = []
    examine = batch._detected

    def counted(image, options):
        seen.append(Path(image.source).name)
        return examine(image, options)

    monkeypatch.setattr(batch, "_detected", counted)
    return seen


def test_an_image_that_was_seen_is_not_looked_at_again(tmp_path: Path, looked: list[str]) -> None:
    (tmp_path / "none.png").write_bytes(cv2.imencode(".png", np.full((300, 400), 128, np.uint8))[1])
    words = ["detect", *IMAGES[:2], tmp_path / "none.png", *BOARD, "--jobs", 1]
    first = succeed(*words, "--cache", tmp_path / "cache")
    assert looked == ["board01.png", "board02.png", "none.png"]
    assert len(list((tmp_path / "cache").iterdir())) == 3
    again = run(*words, "--cache", tmp_path / "cache")
    assert (again.stdout, again.stderr) == (first.stdout, first.stderr)
    assert again.stdout == run(*words).stdout
    assert len(looked) == 6
    # Under another name it is the same image, with its new name in messages.
    shutil.copy(tmp_path / "none.png", tmp_path / "other.png")
    told = run(
        "detect", IMAGES[0], tmp_path / "other.png", *BOARD, "--jobs", 1, "--cache", tmp_path / "cache"
    )
    assert "other.png: " in told.stderr
    assert len(looked) == 6
    # Anything else that is asked for is looked at.
    for more in (["--points", "vertices"], ["--gamma", 2.2], ["--overlay", tmp_path / "o"]):
        run("detect", IMAGES[0], *BOARD, "--cache", tmp_path / "cache", *more)
    run("detect", IMAGES[0], "--cols", 9, "--rows", 6, "--square", 26, "--cache", tmp_path / "cache")
    assert len(looked) == 10
    run("detect", IMAGES[0], *BOARD, "--cache", tmp_path / "cache", "--overlay", tmp_path / "o2")
    assert len(looked) == 10
    assert (tmp_path / "o2" / "board01.png").read_bytes() == (tmp_path / "o" / "board01.png").read_bytes()


def test_a_run_that_was_stopped_goes_on(
    tmp_path: Path, looked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = batch._detected

    def stopped(image, options):
        if image.source.endswith("board03.png"):
            raise KeyboardInterrupt
        return counted(image, options)

    monkeypatch.setattr(batch, "_detected", stopped)
    words = ["detect", *IMAGES, *BOARD, "--jobs", 1, "--cache", tmp_path / "cache", "-o", tmp_path / "p.csv"]
    assert run(*words).exit_code == 130
    assert not (tmp_path / "p.csv").exists()
    monkeypatch.setattr(batch, "_detected", counted)
    succeed(*words)
    assert looked == ["board01.png", "board02.png", "board03.png"]
    assert read_points([tmp_path / "p.csv"]).n_views == 3


def test_a_damaged_cache_is_ignored(tmp_path: Path, looked: list[str]) -> None:
    words = ["detect", IMAGES[0], *BOARD, "--cache", tmp_path / "cache"]
    first = run(*words)
    (file,) = (tmp_path / "cache").iterdir()
    tree = json.loads(file.read_text())
    for content in (
        "",
        "{}",
        "[1]",
        json.dumps({**tree, "detection": {**tree["detection"], "pixels": [[1]]}}),
    ):
        file.write_text(content)
        assert run(*words).stdout == first.stdout
    assert len(looked) == 5
    (tmp_path / "file").touch()
    result = run("detect", IMAGES[0], *BOARD, "--cache", tmp_path / "file")
    assert result.exit_code == 2
    assert "--cache" in result.stderr


def test_a_cache_that_cannot_be_written_to_costs_no_detection(tmp_path: Path) -> None:
    words = ["detect", IMAGES[0], *BOARD, "--cache", tmp_path / "cache"]
    first = run(*words)
    (file,) = (tmp_path / "cache").iterdir()
    file.unlink()
    file.mkdir()
    again = succeed(*words)
    assert again.stdout == first.stdout
    assert "the detection is not cached: " in again.stderr


def film(path: Path, fourcc: str) -> None:
    """Boards that are held still for a moment, one after the other, with blurred frames in between."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*fourcc), 30, (400, 300))
    if not writer.isOpened():
        pytest.skip(f"OpenCV has no codec {fourcc} here")
    rng = np.random.default_rng(0)
    images = [cv2.imread(str(image)) for image in IMAGES]
    for now, after in zip(images, [*images[1:], images[0]], strict=True):
        for _ in range(16):
            writer.write(np.clip(now + rng.normal(0, 2, now.shape), 0, 255).astype(np.uint8))
        for share in np.linspace(0.1, 0.9, 10):
            writer.write(cv2.GaussianBlur(cv2.addWeighted(now, 1 - share, after, share, 0), (0, 0), 5))
    writer.release()


@pytest.mark.parametrize(
    ("ending", "fourcc"), slow_but((("avi", "MJPG"),), (("avi", "MJPG"), ("mp4", "mp4v")))
)
def test_a_video_gives_its_sharp_and_different_frames(ending: str, fourcc: str, tmp_path: Path) -> None:
    film(tmp_path / f"clip.{ending}", fourcc)
    result = succeed("detect", tmp_path / f"clip.{ending}", *BOARD, "-o", tmp_path / "points.csv")
    assert "3 of 78 frames are sharp and differ" in result.stderr
    points = read_points([tmp_path / "points.csv"])
    numbers = [int(name.removeprefix("clip_")) for name in points.view_names]
    assert [number // 26 for number in numbers] == [0, 1, 2]
    assert all(number % 26 < 16 for number in numbers)
    truth = read_points([_points_of(IMAGES, tmp_path)])
    assert np.abs(points.pixels - truth.pixels).max() < 1.0
    result = run("detect", tmp_path / f"clip.{ending}", *BOARD, "--frames", 2)
    assert "2 of 78 frames" in result.stderr


def _points_of(images: tuple[Path, ...], folder: Path) -> Path:
    succeed("detect", *images, *BOARD, "-o", folder / "truth.csv")
    return folder / "truth.csv"


@pytest.mark.slow
def test_frames_without_a_board_are_named_without_their_folder(tmp_path: Path) -> None:
    film(tmp_path / "clip.avi", "MJPG")
    result = run("detect", tmp_path / "clip.avi", "--cols", 5, "--rows", 4, "--square", 25)
    assert result.exit_code == 1
    assert any(line.startswith("clip_0000") for line in result.stderr.splitlines())


def test_no_frame_is_chosen_twice_and_none_of_nothing() -> None:
    rng = np.random.default_rng(1)
    frames = [rng.integers(0, 256, (60, 80), np.uint8) for _ in range(3)]
    frames = [np.kron(frame[:6, :8], np.ones((10, 10), np.uint8)) for frame in frames for _ in range(8)]
    assert len(choose_frames(frames, 50)) == 3
    assert len(choose_frames(frames[:8], 50)) == 1
    assert choose_frames([], 50) == []
    photographs = frames[::8]  # a video of one a second
    assert choose_frames(photographs, 50, 1.0) == [0, 1, 2]
    assert len(choose_frames(photographs, 50)) == 1


def test_a_folder_is_watched_until_no_more_images_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    coming, folder = list(IMAGES), tmp_path / "images"
    folder.mkdir()
    monkeypatch.setattr(frames, "_PAUSE", 0.01)
    pause = frames.time.sleep

    def copy_one(seconds: float) -> None:
        if coming:
            shutil.copy(coming.pop(0), folder)
        pause(seconds)

    monkeypatch.setattr(frames.time, "sleep", copy_one)
    result = succeed("detect", folder, *BOARD, "--watch", 0.5, "-o", tmp_path / "points.csv")
    lines = result.stderr.splitlines()
    assert lines[0].startswith("board01.png: 93 points, 1 view: no camera yet: ")
    assert any(line.startswith("board03.png: 93 points, 3 views: rms 0.0") for line in lines)
    assert any(line.startswith("  next: target ") for line in lines)
    assert (tmp_path / "points.csv").read_bytes() == _points_of(IMAGES, tmp_path).read_bytes()
    result = run("detect", tmp_path / "nothing*.png", *BOARD, "--watch", 0.05)
    refused(result, "no image came within 0.05 seconds")
    assert run("detect", "-", *BOARD, "--watch", 1).exit_code == 2


def test_the_watch_goes_on_past_as_many_images_of_another_size(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for name in ("board01.png", "photo01.jpg", "photo02.jpg"):
        (folder / name).write_bytes((SAMPLES / name).read_bytes())
    result = succeed("detect", folder, *BOARD, "--watch", 0.5, "-o", tmp_path / "points.csv")
    assert "as many have" in result.stderr
    assert "2 of 3 images" in result.stderr


def test_the_watch_goes_on_past_names_that_cannot_be_those_of_views(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for name in ("board01.png", "board01.PNG", "a\nb.png"):
        (folder / name).write_bytes((SAMPLES / "board01.png").read_bytes())
    points = tmp_path / "points.csv"
    result = succeed("detect", folder, *BOARD, "--watch", 0.5, "-o", points)
    assert "would both be the view 'board01'; rename one of them; it is left out" in result.stderr
    assert "b.png has a line break in its name; rename it; it is left out" in result.stderr
    assert "1 of 1 images" in result.stderr
    points.unlink()
    (folder / "board01.PNG").unlink()
    for words in ([folder], [folder / "board01.png", "--board-name", "a/b"]):
        result = run("detect", *words, *BOARD, "-o", points)
        assert result.exit_code == 1
        assert "board detected" not in result.stderr  # told before the images are examined
        assert not points.exists()


def test_an_interrupt_ends_the_watch_and_the_points_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks = iter(range(100))

    def interrupt(seconds: float) -> None:
        if next(looks) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(frames.time, "sleep", interrupt)
    succeed("detect", IMAGES[0], *BOARD, "--watch", 60, "-o", tmp_path / "points.csv")
    assert read_points([tmp_path / "points.csv"]).n_points == 93
