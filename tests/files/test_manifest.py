"""Manifests and trees of folders: what they hold, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from neurocal_cli.errors import FormatError, InputError, NeurocalError
from neurocal_cli.files.batch_files import locked, publish, read_data_sets, read_record, work_folder


def test_a_manifest_names_its_columns_and_leaves_empty_cells_out(tmp_path: Path) -> None:
    path = tmp_path / "fleet.csv"
    path.write_text("# sets\nname;Points;no_skew\nfirst;a.csv;\n\nsecond; b.csv ;yes\n")
    first, second = read_data_sets(str(path))
    assert (first.name, dict(first.cells), first.place) == ("first", {"points": "a.csv"}, f"{path}:3")
    assert dict(second.cells) == {"points": "b.csv", "no-skew": "yes"}
    assert second.folder == str(tmp_path)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("name,points\n", "has no rows"),
        ("points\na.csv\n", "needs a column name"),
        ("name,points,points\na,b,c\n", "each column once"),
        ("name,points\n../a,b.csv\n", "cannot be that of a folder"),
        ("name,points\n,b.csv\n", "cannot be that of a folder"),
        ("name,points\na,b.csv,c.csv\n", "has 3 cells"),
        ("name,points\na,b.csv\nA,c.csv\n", "is that of"),
    ],
)
def test_a_wrong_manifest_is_refused_with_its_line(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "fleet.csv"
    path.write_text(text)
    with pytest.raises((FormatError, InputError), match=told):
        read_data_sets(str(path))


def test_the_leaves_of_a_tree_are_data_sets_with_the_nearest_board(tmp_path: Path) -> None:
    for name in ("line1/cam1", "line1/cam2", "line2/cam1", "empty", ".hidden/cam9"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("line1/cam1/a.png", "line1/cam2/a.JPG", ".hidden/cam9/a.png", "line2/cam1/p.csv"):
        (tmp_path / name).touch()
    for name in ("board.yaml", "line1/cam2/board.yaml"):
        (tmp_path / name).touch()
    found = {one.name: dict(one.cells) for one in read_data_sets(str(tmp_path))}
    assert found == {
        "line1-cam1": {"images": ".", "board": str(tmp_path / "board.yaml")},
        "line1-cam2": {"images": ".", "board": str(tmp_path / "line1/cam2/board.yaml")},
        "line2-cam1": {"points": "p.csv"},
    }
    with pytest.raises(InputError, match="no folder in it holds images"):
        read_data_sets(str(tmp_path / "empty"))


@pytest.mark.parametrize(
    ("files", "columns"),
    [
        (("left.csv", "right.csv"), {"points": "left.csv", "right": "right.csv"}),
        (("cam0.csv", "cam1.csv", "cam10.csv"), {f"cam{k}": f"cam{k}.csv" for k in (0, 1, 10)}),
        (("a.csv", "b.csv"), {"points": "a.csv;b.csv"}),
    ],
)
def test_names_of_points_tell_a_pair_and_a_rig(
    files: tuple[str, ...], columns: dict[str, str], tmp_path: Path
) -> None:
    for name in files:
        (tmp_path / name).touch()
    (found,) = read_data_sets(str(tmp_path))
    assert found.cells == columns


def test_two_batches_do_not_work_in_one_folder_and_what_a_killed_one_left_is_removed(tmp_path: Path) -> None:
    left = work_folder(str(tmp_path / "a"))
    with locked(str(tmp_path)):
        assert not Path(left).exists()
        with pytest.raises(NeurocalError, match="another batch works here"), locked(str(tmp_path)):
            pass
    with locked(str(tmp_path)):
        pass
    assert list(tmp_path.iterdir()) == []


def test_new_results_take_the_place_of_the_old_ones(tmp_path: Path) -> None:
    for content in ("old", "new"):
        made = Path(work_folder(str(tmp_path / "a")))
        (made / content).touch()
        publish(str(made), str(tmp_path / "a"))
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["new"]
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert read_record(str(tmp_path / "a")) == {}
