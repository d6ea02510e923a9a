"""Reading and writing whole files, and what is said when that fails."""

from __future__ import annotations

import io
import os
import stat
import sys
from pathlib import Path

import pytest

from neurocal_cli.errors import FormatError, NeurocalError
from neurocal_cli.files.reading import decode, read_blocks, read_bytes
from neurocal_cli.files.writing import write_chunks, write_whole

AS_ROOT = hasattr(os, "geteuid") and os.geteuid() == 0


class Stdin:
    def __init__(self, data):
        self.buffer = io.BytesIO(data)


def left_behind(folder):
    return [path.name for path in folder.iterdir() if path.name.endswith(".tmp")]


def test_a_dash_reads_stdin(monkeypatch):
    monkeypatch.setattr(sys, "stdin", Stdin(b"abc"))
    assert read_bytes("-") == (b"abc", "<stdin>")


def test_a_closed_stdin_is_an_error_in_one_line(monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(FormatError, match="stdin cannot be read"):
        read_bytes("-")


def test_a_file_that_cannot_be_read_says_why(tmp_path):
    with pytest.raises(FormatError, match="no such file"):
        read_bytes(tmp_path / "absent")
    with pytest.raises(FormatError, match="is a folder"):
        read_bytes(tmp_path)
    with pytest.raises(FormatError, match="check the path"):
        read_bytes("a\0b")
    with pytest.raises(FormatError, match="check the path"):
        read_bytes(tmp_path / ("x" * 300))


@pytest.mark.skipif(AS_ROOT, reason="root may read everything")
def test_a_file_without_permission_says_so(tmp_path):
    path = tmp_path / "secret"
    path.write_text("x")
    path.chmod(0)
    with pytest.raises(FormatError, match="may not be read"):
        read_bytes(path)


def test_a_path_with_a_line_break_stays_on_one_line():
    with pytest.raises(FormatError) as caught:
        read_bytes("no\nsuch\nfile")
    assert str(caught.value).isprintable()


def test_utf8_is_decoded_with_and_without_a_mark():
    assert decode("né".encode(), "f") == "né"
    assert decode("né".encode("utf-8-sig"), "f") == "né"
    assert decode(b"", "f") == ""


def test_other_encodings_and_binary_files_are_told_apart():
    with pytest.raises(FormatError, match="UTF-16"):
        decode("text".encode("utf-16-be"), "f")
    with pytest.raises(FormatError, match="UTF-32"):
        decode("text".encode("utf-32"), "f")
    with pytest.raises(FormatError, match="binary file, not a YAML file"):
        decode(b"GIF89a\0\0\0\1\2", "f", "a YAML file")
    with pytest.raises(FormatError, match=r"f:2: byte 0xe9"):
        decode(b"a\n\xe9", "f")


def test_a_new_file_gets_the_permissions_that_the_umask_leaves(tmp_path):
    former = os.umask(0o027)
    try:
        write_whole(tmp_path / "new", "text")
    finally:
        os.umask(former)
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o640


def test_an_existing_file_keeps_its_permissions(tmp_path):
    path = tmp_path / "old"
    path.write_text("old")
    path.chmod(0o604)
    write_whole(path, "new")
    assert path.read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o604


@pytest.mark.skipif(AS_ROOT, reason="root may write everything")
def test_a_write_protected_file_is_not_replaced(tmp_path):
    path = tmp_path / "old"
    path.write_text("old")
    path.chmod(0o444)
    with pytest.raises(NeurocalError, match="may not be written"):
        write_whole(path, "new")
    assert path.read_text() == "old"


def test_a_symbolic_link_stays_and_its_target_is_written(tmp_path):
    (tmp_path / "folder").mkdir()
    target = tmp_path / "folder" / "target"
    link = tmp_path / "link"
    link.symlink_to(target)
    write_whole(link, "one")  # the target does not exist yet
    write_whole(link, "two")
    assert link.is_symlink()
    assert target.read_text() == "two"


@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_a_failure_leaves_the_old_file_and_no_rubbish(tmp_path, monkeypatch, failure):
    path = tmp_path / "file"
    path.write_text("old")

    def fail(_):
        raise failure

    monkeypatch.setattr(os, "fsync", fail)
    expected = KeyboardInterrupt if failure is KeyboardInterrupt else NeurocalError
    with pytest.raises(expected):
        write_whole(path, "new")
    assert path.read_text() == "old"
    assert left_behind(tmp_path) == []


def test_a_place_that_cannot_be_written_says_why(tmp_path):
    with pytest.raises(NeurocalError, match="its folder does not exist"):
        write_whole(tmp_path / "no" / "file", "x")
    with pytest.raises(NeurocalError, match="is a folder"):
        write_whole(tmp_path, "x")
    with pytest.raises(NeurocalError, match="give another place"):
        write_whole(tmp_path / "\0", "x")
    (tmp_path / "file").write_text("x")
    with pytest.raises(NeurocalError, match="give another place"):
        write_whole(tmp_path / "file" / "below", "x")


def test_text_that_utf8_cannot_hold_is_refused(tmp_path):
    with pytest.raises(NeurocalError, match="rename"):
        write_whole(tmp_path / "file", "\ud800")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["-", "/dev/stdout"])
def test_a_dash_writes_stdout(capfdbinary, name):
    write_whole(name, "µm\n")
    assert capfdbinary.readouterr().out == "µm\n".encode()


def test_a_stdout_of_text_alone_is_written_too(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stdout", stream)
    write_whole("-", b"abc")
    assert stream.getvalue() == "abc"


def test_the_command_runner_of_click_sees_what_is_written():
    click = pytest.importorskip("click")
    testing = pytest.importorskip("click.testing")

    @click.command()
    def command():
        data, _ = read_bytes("-")
        write_whole("-", data.upper())

    assert testing.CliRunner().invoke(command, input="abc").stdout == "ABC"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_named_pipe_is_written_directly(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_whole(pipe, "through")
    assert os.read(reader, 100) == b"through"
    os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_device_is_an_error_in_one_line():
    with pytest.raises(NeurocalError, match="no space left"):
        write_whole("/dev/full", "x")


def test_blocks_end_at_line_ends_and_add_up(tmp_path):
    data = b"".join(b"%d" % k * (k % 7) + b"\n" for k in range(100)) + b"no end"
    (tmp_path / "f").write_bytes(data)
    blocks = list(read_blocks(tmp_path / "f", 20))
    assert b"".join(blocks) == data
    assert len(blocks) > 5
    assert all(block.endswith(b"\n") for block in blocks[:-1])
    (tmp_path / "f").write_bytes(b"")
    assert list(read_blocks(tmp_path / "f", 20)) == []
    with pytest.raises(FormatError, match="there is no such file"):
        next(read_blocks(tmp_path / "absent", 20))


def test_a_fault_among_the_chunks_leaves_the_former_file(tmp_path):
    (tmp_path / "f").write_text("old")

    def chunks():
        yield "new"
        raise FormatError("is wrong", "input", 7)

    with pytest.raises(FormatError, match="input:7: is wrong"):
        write_chunks(tmp_path / "f", chunks())
    assert (tmp_path / "f").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["f"]
    write_chunks(tmp_path / "f", iter(["a", b"b", "c"]))
    assert (tmp_path / "f").read_text() == "abc"
