"""Good and bad sets of photographs, rendered, and what `neurocal` says of each: a picture and its words.

The words go into ``docs/how-to/photograph.md``, into the block after the mark of each set. All sets show the
same board with the same camera, that of the sample photographs.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

import cv2
import numpy as np

from neurocal_cli import Board, Correspondences, NeurocalError, calibrate, detect_points, read_image
from neurocal_cli.commands.show.text import verdict_lines

HERE = Path(__file__).resolve().parent
SAMPLES = HERE.parents[1] / "sample_data"
PAGE = HERE.parent / "how-to" / "photograph.md"
BOARD = Board.single(9, 6, 25.0)
SMALL = (220, 165)  # of a picture on a sheet [px]
sys.path.append(str(SAMPLES))
import make_photos  # noqa: E402 - the renderer of the sample photographs

# Of each picture: where the board's middle is, its distance [mm], tilt, side of the tilt, and roll [degrees].
PARALLEL = [
    (0.50, 0.50, 330, 2, 0, 3), (0.35, 0.40, 400, 3, 90, -4), (0.65, 0.40, 420, 2, 200, 6),
    (0.40, 0.62, 450, 3, 10, 88), (0.60, 0.60, 380, 1, 150, 2), (0.50, 0.45, 520, 3, 280, -88),
    (0.35, 0.50, 480, 2, 30, 5), (0.62, 0.50, 350, 2, 300, -2),
]  # fmt: skip
SMALL_IN_THE_MIDDLE = [
    (0.50, 0.50, 1000, 35, side, roll)
    for side, roll in zip(range(0, 360, 45), (0, 8, -5, 90, 4, 176, -7, 85), strict=True)
]
UPRIGHT = [
    (u, v, distance, 30, 0, 2)
    for u, v, distance in (
        (0.50, 0.50, 350), (0.40, 0.45, 380), (0.60, 0.45, 400), (0.42, 0.60, 420), (0.60, 0.60, 390),
        (0.50, 0.40, 450), (0.36, 0.50, 430), (0.65, 0.52, 410),
    )
]  # fmt: skip
MOVED = 40  # px


def of_samples(numbers: Iterable[int]) -> Iterator[np.ndarray]:
    return (read_image(str(SAMPLES / f"photo{number:02d}.jpg")).grey for number in numbers)


def rendered(views, seed: int, anew: float = make_photos.ANEW, zoom: float = 0.0, moved: int = 1):
    """Pictures of a set: paper that bends `anew` [mm], a focal length that differs by a share `zoom`."""
    for number, pose in zip(count(1), make_photos.poses(views)):
        rng = np.random.default_rng(seed + number)
        bend, known = make_photos.bent(rng, anew), make_photos.CAMERA
        A, grown = known.intrinsics, 1 + zoom * rng.standard_normal()
        camera = replace(known, intrinsics=replace(A, alpha_u=A.alpha_u * grown, alpha_v=A.alpha_v * grown))
        yield np.round(make_photos.photograph(pose, bend, rng, camera, moved)).astype(np.uint8)


GOOD = make_photos.VIEWS
SETS: dict[str, Callable[[], Iterator[np.ndarray]]] = {
    "good": lambda: of_samples(range(1, 13)),
    "parallel": lambda: rendered(PARALLEL, 200),
    "middle": lambda: rendered(SMALL_IN_THE_MIDDLE, 300),
    "one-side": lambda: rendered(UPRIGHT, 400),
    "few": lambda: of_samples((2, 5, 9)),
    "soft": lambda: rendered(GOOD, 500, anew=1.5),
    "autofocus": lambda: rendered(GOOD, 600, zoom=0.012),
}


def words(images: list[np.ndarray]) -> list[str]:
    """What `neurocal calibrate` says of a set: the focal length, and the verdict."""
    found = {
        f"photo{number:02d}": detect_points(image, BOARD) for number, image in enumerate(images, start=1)
    }
    try:
        camera = calibrate(Correspondences.from_detections(found), skew=False)
    except NeurocalError as error:
        return [f"Error: {error}"]
    table = camera.summary().splitlines()
    return [line for line in table if line.startswith("alpha_u")] + verdict_lines(camera.verdict)


def sheet(images: list[np.ndarray]) -> np.ndarray:
    """All pictures of a set, small, four in a row."""
    small = [cv2.resize(image.astype(np.uint8), SMALL, interpolation=cv2.INTER_AREA) for image in images]
    small = [cv2.copyMakeBorder(one, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=255) for one in small]
    small += [np.full_like(small[0], 255)] * (-len(small) % 4 if len(small) > 4 else 0)
    return np.vstack([np.hstack(small[k : k + 4]) for k in range(0, len(small), 4)])


def spoilt() -> dict[str, np.ndarray]:
    """Single pictures in which no board is found, or not all of it."""
    pose = list(make_photos.poses([(0.5, 0.5, 350, 30, 20, 4), (0.93, 0.5, 330, 20, 60, 4)]))
    rng = np.random.default_rng(700)
    bend = make_photos.bent(rng)
    whole = make_photos.photograph(pose[0], bend, rng)
    u, v = np.meshgrid(np.linspace(-1, 1, 640), np.linspace(-0.75, 0.75, 480))
    glare = 190 * np.exp(-((u - 0.1) ** 2 + (v + 0.1) ** 2) / 0.03)
    far = make_photos.photograph(next(make_photos.poses([(0.5, 0.5, 4200, 20, 20, 4)])), bend, rng)
    made = {
        "moved": make_photos.photograph(pose[0], bend, rng, moved=MOVED),
        "cut off": make_photos.photograph(pose[1], bend, rng),
        "far": far,
        "glare": np.clip(whole + 1.5 * glare, 0, 255),
    }
    return {name: np.round(image).astype(np.uint8) for name, image in made.items()}


def said_of(image: np.ndarray) -> str:
    """What `neurocal detect` says of a picture."""
    try:
        return f"{len(detect_points(image, BOARD).ids)} points of 93"
    except NeurocalError as error:
        return str(error)


def write(blocks: dict[str, list[str]]) -> None:
    """Put the words of each set into the block after its mark."""
    text = PAGE.read_text(encoding="utf-8")
    for name, lines in blocks.items():
        block = "\n".join(["```text", *lines, "```"])
        text, times = re.subn(
            rf"(<!-- words: {name} -->\n)```text\n.*?```", lambda m, b=block: m[1] + b, text, flags=re.DOTALL
        )
        assert times == 1, name
    PAGE.write_text(text, encoding="utf-8")


def save(name: str, picture: np.ndarray) -> None:
    cv2.imwrite(str(HERE / f"set-{name}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 75])


def main() -> None:
    blocks = {}
    for name, made in SETS.items():
        images = list(made())
        if name != "good":  # whose sheet is photographs.jpg
            save(name, sheet(images))
        blocks[name] = words(images)
    single = spoilt()
    save("spoilt", sheet(list(single.values())))
    blocks["spoilt"] = [f"{name}: {said_of(image)}" for name, image in single.items()]
    write(blocks)


if __name__ == "__main__":
    main()
