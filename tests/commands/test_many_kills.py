"""Two hundred commands, killed at any time: no process, no half of a file, no rest after the next run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from support.places import SAMPLES
from test_killed import alive, descendants

COUNT = int(os.environ.get("NEUROCAL_KILLS", "200"))
COMMANDS = [
    ["detect", *(str(SAMPLES / f"board0{k}.png") for k in range(1, 7)), "--cols", "9", "--rows", "6",
     "--square", "25", "--jobs", "2", "--overlay", "OVERLAYS", "-o", "OUT"],
    ["calibrate", str(SAMPLES / "flat.csv"), "--plot", "OUT.png", "-o", "OUT"],
    ["stereo", str(SAMPLES / "stereo_left.csv"), str(SAMPLES / "stereo_right.csv"), "-o", "OUT"],
    ["lens", "fit", str(SAMPLES / "zoom.csv"), "--distortion", "none", "-o", "OUT"],
]  # fmt: skip


def start(words: list[str], folder: Path) -> subprocess.Popen[bytes]:
    places = {"OUT": folder / "out", "OUT.png": folder / "out.png", "OVERLAYS": folder / "overlays"}
    full = [str(places.get(word, word)) for word in words]
    nothing = subprocess.DEVNULL
    return subprocess.Popen(
        [sys.executable, "-m", "neurocal_cli", *full], stdin=nothing, stdout=nothing, stderr=nothing
    )


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="there is no /proc to see processes in")
def test_commands_that_are_killed_leave_nothing_half_done(tmp_path: Path) -> None:
    whole, seconds = [], []
    for k, words in enumerate(COMMANDS):
        folder = tmp_path / f"whole{k}"
        (folder / "overlays").mkdir(parents=True)
        began = time.monotonic()
        assert start(words, folder).wait(300) == 0
        seconds.append(time.monotonic() - began)
        whole.append(files(folder))
    rng = np.random.default_rng(4)
    wrong = []
    folders = []
    for k in range(len(COMMANDS)):
        folders.append(tmp_path / f"killed{k}")
        (folders[k] / "overlays").mkdir(parents=True)
    for trial in range(COUNT):
        k = trial % len(COMMANDS)
        how = (signal.SIGTERM, signal.SIGKILL)[trial // len(COMMANDS) % 2]
        process = start(COMMANDS[k], folders[k])
        end = time.monotonic() + rng.uniform(0, 1.1) * seconds[k]
        started: set[int] = set()
        while time.monotonic() < end and process.poll() is None:
            started |= descendants(process.pid)
            time.sleep(0.01)
        started |= descendants(process.pid)
        process.send_signal(how)
        process.wait(60)
        end = time.monotonic() + 30
        while any(alive(pid) for pid in started) and time.monotonic() < end:
            time.sleep(0.02)
        if any(alive(pid) for pid in started):
            wrong.append((trial, "a process is left"))
        for name, data in files(folders[k]).items():
            if not name.rpartition("/")[2].startswith(".neurocal-") and data != whole[k].get(name):
                wrong.append((trial, f"{name} is broken"))
    for k, words in enumerate(COMMANDS):
        assert start(words, folders[k]).wait(300) == 0
        if files(folders[k]).keys() != whole[k].keys():
            wrong.append((k, f"left behind: {files(folders[k]).keys() ^ whole[k].keys()}"))
    assert wrong == []
