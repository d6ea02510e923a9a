"""Ten thousand damaged inputs: each is answered or refused, quickly, and nothing else is touched."""

from __future__ import annotations

import hashlib
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run
from support.places import SAMPLES

COUNT = int(os.environ.get("NEUROCAL_FUZZ", "10000"))
FIRST = int(os.environ.get("NEUROCAL_FUZZ_SEED", "0"))
LIMIT = 20  # seconds
ODD = [
    b"nan", b"inf", b"-1", b"0", b"1e308", b"1e-320", b"99999999999999999999", b"", b" ", b",", b"\t", b"\0",
    b"\xff\xfe", b"\n", b"\r", b"#", b":", b"- ", b"{", b"]", b"!!python/object:os.system", b"&a *a", b"'",
    b'"', b"%", b"\xc3\xa9", b"~",
]  # fmt: skip
BOARD = b"unit: mm\nplanes:\n  - {name: only, cols: 9, rows: 6, square: 25.0}\n"


class TooSlowError(Exception):
    pass


@contextmanager
def limited(seconds: int) -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TooSlowError

    former = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, former)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """One to four changes: bytes, lines, fields, cuts, and values that are odd."""
    for _ in range(int(rng.integers(1, 5))):
        lines = data.split(b"\n")
        line, at = int(rng.integers(len(lines))), int(rng.integers(len(data) + 1))
        odd = ODD[int(rng.integers(len(ODD)))]
        kind = int(rng.integers(9))
        if kind == 0:
            data = data[:at] + odd + data[at:]
        elif kind == 1:
            data = data[:at] + bytes([int(rng.integers(256))]) + data[at + 1 :]
        elif kind == 2:
            data = data[:at]
        elif kind == 3:
            data = data[:at] + data[at + int(rng.integers(1, 60)) :]
        elif kind == 4:
            data = b"\n".join(lines[:line] + lines[line + 1 :])
        elif kind == 5:
            data = b"\n".join([*lines[:line], lines[line], *lines[line:]])
        elif kind == 6:
            other = int(rng.integers(len(lines)))
            lines[line], lines[other] = lines[other], lines[line]
            data = b"\n".join(lines)
        else:  # a whole field becomes odd
            cut = b"," if b"," in lines[line] else b" "
            fields = lines[line].split(cut)
            fields[int(rng.integers(len(fields)))] = odd
            lines[line] = cut.join(fields)
            data = b"\n".join(lines)
    return data


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Small inputs of each kind, all of them good."""
    folder = tmp_path_factory.mktemp("sound")
    for words in (
        ["calibrate", SAMPLES / "flat.csv", "-o", folder / "camera.yaml"],
        ["stereo", SAMPLES / "stereo_left.csv", SAMPLES / "stereo_right.csv", "-o", folder / "rig.yaml"],
        ["lens", "fit", SAMPLES / "zoom.csv", "--distortion", "none", "-o", folder / "lens.yaml"],
    ):
        assert run(*words).exit_code == 0
    flat = (SAMPLES / "flat.csv").read_bytes().splitlines(keepends=True)
    some = [line for k, line in enumerate(flat) if k % 5 == 0 or not line.startswith((b"view0", b"view1"))]
    return {
        "points.csv": (SAMPLES / "points.csv").read_bytes(),
        "flat.csv": b"".join(some),
        "matches.csv": (SAMPLES / "matches.csv").read_bytes(),
        "board.yaml": BOARD,
        "image.png": (SAMPLES / "board06.png").read_bytes(),
        **{name: (folder / name).read_bytes() for name in ("camera.yaml", "rig.yaml", "lens.yaml")},
    }


# What is damaged, and the command that reads it; IN is the damaged file, OUT a new one.
COMMANDS = [
    ("points.csv", ["calibrate", "IN", "-o", "OUT"]),
    ("points.csv", ["calibrate", "IN", "--type", "2", "--distortion", "none", "-o", "OUT"]),
    ("flat.csv", ["calibrate", "IN", "--distortion", "none", "-o", "OUT"]),
    ("camera.yaml", ["evaluate", "camera", "IN", "--json"]),
    ("camera.yaml", ["undistort", "IN", "image.png", "-o", "OUT.png"]),
    ("camera.yaml", ["calibrate", "points.csv", "--type", "3", "--intrinsics", "IN", "-o", "OUT"]),
    ("rig.yaml", ["triangulate", "IN", "matches.csv", "-o", "OUT"]),
    ("rig.yaml", ["evaluate", "stereo", "IN", "--json"]),
    ("matches.csv", ["triangulate", "rig.yaml", "IN", "-o", "OUT"]),
    ("lens.yaml", ["lens", "camera", "IN", "--zoom", "3", "-o", "OUT"]),
    ("board.yaml", ["detect", "image.png", "--board", "IN", "-o", "OUT"]),
    ("image.png", ["detect", "IN", "--board", "board.yaml", "-o", "OUT"]),
]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="needs an alarm")
def test_damaged_inputs_are_answered_or_refused(sound: dict[str, bytes], tmp_path: Path) -> None:
    for name, data in sound.items():
        (tmp_path / name).write_bytes(data)
    others = {name: hashlib.sha256(data).digest() for name, data in sound.items()}
    wrong = []
    for trial in range(FIRST, FIRST + COUNT):
        rng = np.random.default_rng([trial, 2026])
        # Images take longer than tables: fewer of them.
        name, words = COMMANDS[
            int(rng.choice(len(COMMANDS), p=np.array([8] * 4 + [1, 8] + [8] * 4 + [1, 1]) / 75))
        ]
        data = damaged(sound[name], rng)
        broken = tmp_path / f"in-{name}"
        broken.write_bytes(data)
        places = {"IN": broken, "OUT": tmp_path / "out", "OUT.png": tmp_path / "out.png"}
        full = [str(places.get(word, tmp_path / word if word in sound else word)) for word in words]
        try:
            with limited(LIMIT):
                result = run(*full)
        except TooSlowError:
            wrong.append((trial, name, "too slow"))
            continue
        text = result.stderr + result.stdout
        if isinstance(result.exception, TooSlowError):
            wrong.append((trial, name, "too slow"))
        elif result.exit_code not in (0, 1, 2, 3) or "Traceback" in text or "internal error" in text:
            wrong.append((trial, name, text[-300:] or repr(result.exception)))
        if broken.read_bytes() != data:
            wrong.append((trial, name, "the input was changed"))
        for out in ("out", "out.png"):
            (tmp_path / out).unlink(missing_ok=True)
        broken.unlink()
        left = {path.name for path in tmp_path.iterdir()} - set(sound)
        if left:
            wrong.append((trial, name, f"left behind: {left}"))
            for path in left:
                (tmp_path / path).unlink()
    assert wrong == [], "\n".join(map(str, wrong[:20]))
    for name, digest in others.items():
        assert hashlib.sha256((tmp_path / name).read_bytes()).digest() == digest, name
