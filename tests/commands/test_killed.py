"""A command that is killed leaves no process behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.places import SAMPLES
from support.slow_cases import slow_but

_HANGUP = getattr(signal, "SIGHUP", signal.SIGTERM)  # the terminal is closed; not on Windows


def descendants(pid: int) -> set[int]:
    """Processes that a process has started, and those that these have."""
    parents: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if fields[0] != "Z":
            parents.setdefault(int(fields[1]), []).append(int(stat.parent.name))
    found, new = set[int](), parents.get(pid, [])
    while new:
        found |= set(new)
        new = [child for one in new for child in parents.get(one, [])]
    return found


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="there is no /proc to see processes in")
@pytest.mark.parametrize("how", slow_but((signal.SIGKILL,), [signal.SIGTERM, signal.SIGKILL]))
def test_workers_end_with_a_detection_that_is_killed(tmp_path: Path, how: signal.Signals) -> None:
    picture = (SAMPLES / "board01.png").read_bytes()
    for k in range(200):
        (tmp_path / f"{k}.png").write_bytes(picture)
    words = ["detect", str(tmp_path), "--cols", "9", "--rows", "6", "--square", "25", "--jobs", "2"]
    command = [sys.executable, "-m", "neurocal_cli", *words, "-o", os.devnull]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        end = time.monotonic() + 60
        while len(started := descendants(process.pid)) < 3:  # two workers and what keeps account of them
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.05)
        process.send_signal(how)
        process.wait(60)
    end = time.monotonic() + 60
    while left := {pid for pid in started if alive(pid)}:
        assert time.monotonic() < end, left
        time.sleep(0.05)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="there is no /proc to see processes in")
def test_an_interrupt_while_workers_start_is_told_in_one_line(tmp_path: Path) -> None:
    picture = (SAMPLES / "board01.png").read_bytes()
    for k in range(200):  # so many that the work is not done before the interrupt, however late it comes
        (tmp_path / f"{k}.png").write_bytes(picture)
    words = ["detect", str(tmp_path), "--cols", "9", "--rows", "6", "--square", "25", "--jobs", "2"]
    command = [sys.executable, "-m", "neurocal_cli", "-qq", *words, "-o", os.devnull]
    with subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True) as process:
        end = time.monotonic() + 60
        while len(descendants(process.pid)) < 3:
            assert time.monotonic() < end
            time.sleep(0.01)
        time.sleep(0.2)
        os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to the workers as well
        _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert told == b"Error: interrupted\n"


@pytest.mark.parametrize(
    ("command", "code", "told"),
    [
        ("raise KeyboardInterrupt", 130, "Error: interrupted\n"),
        ("eval('[signal.raise_signal(signal.SIGINT) for _ in range(9)]')", 130, "Error: interrupted\n"),
        ("atexit.register(signal.raise_signal, signal.SIGINT)", 0, ""),
        ("signal.raise_signal(signal.SIGTERM)", 143, ""),
        ("signal.raise_signal(getattr(signal, 'SIGHUP', signal.SIGTERM))", 128 + _HANGUP, ""),
    ],
    ids=["while modules are loaded", "while a module evaluates a text", "while Python ends", "end", "hangup"],
)
def test_an_interrupt_is_no_death_by_signal(command: str, code: int, told: str) -> None:
    lines = (
        "import atexit, signal",
        # Where the tests run under nohup, their processes ignore it.
        f"signal.signal({int(_HANGUP)}, signal.SIG_DFL)",
        "from neurocal_cli import __main__, commands",
        f"def neurocal(prog_name): {command}",
        "commands.neurocal = neurocal",
        "__main__.main()",
    )
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (code, told)
