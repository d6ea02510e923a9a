"""Corners that other programs measured, and points as other programs take them."""

from __future__ import annotations

import gzip
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.command_line import refused, run, succeed
from support.real_data import RealFiles

from neurocal_cli import Board, Correspondences, calibrate, read_points, read_rig_points, write_points
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError
from neurocal_cli.files.exchange.corner_texts import corner_text
from neurocal_cli.files.exchange.corners import read_corners
from neurocal_cli.files.exchange.mat_file import saved

BOARD = Board.single(5, 4, 25.0)
SIZE = ["--cols", 5, "--rows", 4, "--square", 25]
WORLD = BOARD.planes[0].vertices().reshape(-1, 3)


def pixels(views: int = 3) -> Array:
    return np.random.default_rng(1).uniform(0, 600, (views, 20, 2))


def points(seen: Array) -> Correspondences:
    found = np.isfinite(seen).all(axis=2)
    ids = np.array(BOARD.planes[0].vertex_ids())
    return Correspondences(
        np.broadcast_to(WORLD, (len(seen), 20, 3))[found],
        seen[found],
        np.repeat([f"im{k}" for k in range(len(seen))], 20).reshape(-1, 20)[found],
        (640, 480),
        point=np.tile(ids, (len(seen), 1))[found],
    )


def rows(found: Correspondences) -> dict[tuple[str, str], list[float]]:
    assert found.point is not None
    return {
        (found.view_names[k], str(label)): [*world, *pixel]
        for k, label, world, pixel in zip(
            found.view_index, found.point, found.world.tolist(), found.pixels.tolist(), strict=True
        )
    }


@pytest.mark.parametrize("gap", [False, True], ids=["whole", "with gaps"])
@pytest.mark.parametrize(
    ("target", "ending"),
    [("opencv", ".yaml"), ("opencv", ".xml"), ("opencv", ".json"), ("matlab", ".mat"), ("json", ".json"),
     ("npz", ".npz"), ("mrcal", ".vnl"), ("neurocal", ".csv")],
)  # fmt: skip
def test_points_come_back_from_each_format(target: str, ending: str, gap: bool, tmp_path: Path) -> None:
    seen = pixels()
    if gap:
        seen[1, 3] = seen[2, 19] = np.nan
    write_points(points(seen), tmp_path / "points.csv")
    given = read_points(tmp_path / "points.csv")
    place = tmp_path / f"corners{ending}"
    result = run("convert", tmp_path / "points.csv", "--to", target, "-o", place)
    if gap and target == "opencv":
        refused(result, "2 of 20 points are not in all views")
        return
    assert result.exit_code == 0, result.stderr
    words = SIZE if target == "mrcal" else []
    result = succeed("convert", place, *words, "--to", "neurocal", "-o", tmp_path / "again.csv")
    found = read_points(tmp_path / "again.csv")
    if target == "matlab":  # it has no ids of points
        assert np.abs(found.pixels - given.pixels).max() < 1e-9
        assert np.abs(found.world - given.world).max() == 0
    else:
        assert rows(found) == rows(given)
    assert (found.unit, found.image_size) == ("mm", None if target == "mrcal" else (640, 480))


def test_opencv_opens_the_matrices(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    for ending in (".yml", ".xml", ".json"):
        place = tmp_path / f"corners{ending}"
        place.write_text(str(corner_text(points(pixels()), "opencv", ending)))
        storage = cv2.FileStorage(str(place), cv2.FILE_STORAGE_READ)
        assert np.abs(storage.getNode("image_points").mat() - pixels()).max() == 0
        assert np.abs(storage.getNode("object_points").mat().reshape(-1, 3) - WORLD).max() == 0
        assert storage.getNode("view_names").at(1).string() == "im1"


def test_opencv_s_packed_corners_are_read(tmp_path: Path) -> None:
    place = tmp_path / "corners.yml.gz"
    place.write_bytes(gzip.compress(str(corner_text(points(pixels()), "opencv", ".yml")).encode()))
    found = read_corners([place], None, [])
    assert found is not None
    assert rows(found) == rows(points(pixels()))


def test_corners_as_opencv_s_calibration_sample_writes_them_are_read(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    storage = cv2.FileStorage(str(tmp_path / "out.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_points", pixels().astype(np.float32))
    storage.write("grid_points", WORLD.reshape(-1, 1, 3).astype(np.float32))
    storage.release()
    found = read_corners([tmp_path / "out.yml"], None, [])
    assert found is not None
    assert np.abs(found.pixels - pixels().reshape(-1, 2)).max() < 1e-4
    assert np.abs(found.world[:20] - WORLD).max() == 0


SHAPES = {
    "views x points x 2": (3, 20, 2),
    "as findChessboardCorners returns them": (3, 20, 1, 2),
}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_arrays_of_numpy_are_corners(shape: tuple[int, ...], tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", pixels().reshape(shape))
    np.savez(tmp_path / "a.npz", imgpoints=pixels().reshape(shape), objpoints=np.tile(WORLD, (3, 1, 1)))
    for name, board in (("a.npy", BOARD), ("a.npz", None)):
        found = read_corners([tmp_path / name], board, [])
        assert found is not None
        assert np.abs(found.pixels - pixels().reshape(-1, 2)).max() == 0
        assert np.abs(found.world[20:40] - WORLD).max() == 0
        assert found.unit == ("mm" if board else "unknown")


def test_one_view_of_opencv_s_shape_is_a_view(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", pixels(1)[0][:, None])
    found = read_corners([tmp_path / "a.npy"], BOARD, [])
    assert found is not None
    assert found.n_views == 1


def test_the_table_of_mrcal_has_levels_gaps_and_outliers(tmp_path: Path) -> None:
    lines = ["## made by mrgingham", "# filename x y level"]
    for name in ("a/1.png", "a/2.png"):
        lines += [f"{name} {k}.5 {k}.25 {k % 3}" for k in range(18)] + [f"{name} - - -", f"{name} 3 4 -1"]
    lines += ["a/3.png 1 2 0", "a/3.png - - -"]
    (tmp_path / "corners.vnl").write_text("\n".join(lines))
    with pytest.raises(FormatError, match="different numbers of corners"):
        read_corners([tmp_path / "corners.vnl"], BOARD, [])
    lines[-2:] = ["a/3.png - - -", "a/4.png - -"]  # no board in these images
    (tmp_path / "corners.vnl").write_text("\n".join(lines))
    found = read_corners([tmp_path / "corners.vnl"], BOARD, [])
    assert found is not None
    assert found.view_names == ("1", "2")
    assert found.n_points == 36
    assert found.covariance is not None
    assert found.covariance[:3, 0].tolist() == [1, 4, 16]


def test_files_of_places_and_pixels_apart(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "world.txt", WORLD)
    for k, view in enumerate(pixels()):
        np.savetxt(tmp_path / f"im{k}.txt", view, delimiter=",")
    names = [tmp_path / name for name in ("world.txt", "im0.txt", "im1.txt", "im2.txt")]
    for words in (names, [*names[1:], *SIZE]):
        succeed("convert", *words, "--to", "neurocal", "--unit", "cm", "-o", tmp_path / "p.csv")
        found = read_points(tmp_path / "p.csv")
        assert found.view_names == ("im0", "im1", "im2")
        assert found.unit == "cm"
        assert np.abs(found.pixels - pixels().reshape(-1, 2)).max() < 1e-9


def test_the_points_of_zhang_calibrate(real_files: RealFiles, tmp_path: Path) -> None:
    """His files have the four corners of a square in a row; the known camera is the published one."""
    (model,) = real_files("zhang_planar/Model.txt")
    np.savetxt(tmp_path / "world.txt", np.loadtxt(model).reshape(-1, 2))
    views = []
    for path in real_files("zhang_planar/data?.txt"):
        views.append(tmp_path / path.name)
        np.savetxt(views[-1], np.loadtxt(path).reshape(-1, 2))
    found = read_corners([tmp_path / "world.txt", *views], None, [], "inch")
    assert found is not None
    camera = calibrate(found, distortion="k1k2")
    assert abs(camera.K[0, 0] - 832.5) < 1
    assert abs(camera.K[1, 1] - 832.53) < 1


REFUSED = {
    '{"corners": [[[1, 2], [3, 4]]]}': "corners has 2 corners a view, but not their places on the board",
    '{"corners": [[[1, 2], [3, 4]], [[1, 2]]]}': "corners must be the same number of points in each view",
    '{"corners": [[[1, 2]]], "objpoints": [[1, 2, 3], [4, 5, 6]]}': "corners must be 2 points in each view",
    '{"corners": [[[1, 2]]], "objpoints": [[1, 2, 3]], "points": ["a", "b"]}': "points must be 1 diff",
    '{"corners": [[["a", 2]]]}': "corners must be the same number",
    "1 2 3\n": "/file: holds places alone",
    "1 2 3\n1 2\n": ":2: must be a row of 2 numbers or of 3",
    "# filename x y level\na 1\n": ":2: is not a line 'filename x y level'",
    "Calibration results \n====================\n": "Kalibr has no file of corners",
}


@pytest.mark.parametrize("text", REFUSED, ids=list(REFUSED.values()))
def test_a_fault_is_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text(text)
    result = run("convert", tmp_path / "file", "--to", "neurocal")
    refused(result, REFUSED[text])


def test_corners_of_matlab_run_down_the_columns_of_the_board(tmp_path: Path) -> None:
    seen = pixels().round()  # so that pixels counted from 1 are exact
    down = np.arange(20).reshape(4, 5).T.ravel()
    matlab = {"imagePoints": np.moveaxis(seen[:, down], 0, 2) + 1}
    board = {"boardSize": np.array([[5.0, 6.0]]), "squareSize": np.array([[25.0]])}
    for variables, known in ((matlab, BOARD), (matlab | board, None)):
        (tmp_path / "points.mat").write_bytes(saved(variables))
        found = read_corners([tmp_path / "points.mat"], known, [])
        assert found is not None
        assert list(rows(found).values()) == [
            rows(points(seen))[f"im{view}", BOARD.planes[0].vertex_ids()[k]]
            for view in range(3)
            for k in down
        ]
    for wrong, told in (
        ({"imagePoints": np.zeros((20, 2, 3, 2))}, "those of two cameras"),
        (matlab | board | {"boardSize": np.array([[np.nan, 6.0]])}, "are not those of a board"),
    ):
        (tmp_path / "wrong.mat").write_bytes(saved(wrong))
        with pytest.raises(FormatError, match=told):
            read_corners([tmp_path / "wrong.mat"], None, [])


@pytest.mark.parametrize(
    ("target", "ending"), [("mrcal", ".vnl"), ("json", ".json"), ("npz", ".npz"), ("matlab", ".mat")]
)
def test_points_come_through_pipes(target: str, ending: str, tmp_path: Path) -> None:
    """As in ``neurocal detect ... | neurocal convert - --to mrcal``, and back."""
    write_points(points(pixels()), tmp_path / "points.csv")
    by_name = tmp_path / f"corners{ending}"
    succeed("convert", tmp_path / "points.csv", "--to", target, "-o", by_name)
    piped = tmp_path / f"piped{ending}"
    csv = (tmp_path / "points.csv").read_bytes()
    result = succeed("convert", "-", "--to", target, "-o", piped, stdin=csv)
    assert "60 points of 3 views" in result.stderr
    if target != "matlab":  # it stores the time
        assert piped.read_bytes() == by_name.read_bytes()
    words = SIZE if target == "mrcal" else []
    result = run("convert", "-", *words, "--to", "neurocal", stdin=piped.read_bytes())
    again = run("convert", by_name, *words, "--to", "neurocal")
    assert result.exit_code == again.exit_code == 0, result.stderr
    assert result.stdout == again.stdout


@pytest.mark.parametrize("text", [b"1 2 3", b"a: ["])
def test_what_is_neither_camera_nor_points_is_refused_from_stdin_as_from_a_file(
    text: bytes, tmp_path: Path
) -> None:
    (tmp_path / "file").write_bytes(text)
    piped, file = (
        run("convert", "-", "--to", "ros", stdin=text),
        run("convert", tmp_path / "file", "--to", "ros"),
    )
    assert piped.exit_code == file.exit_code == 1
    assert piped.stderr == file.stderr.replace(str(tmp_path / "file"), "<stdin>")


def test_calibrate_says_what_to_do_with_corners_of_other_programs(tmp_path: Path) -> None:
    np.savez(tmp_path / "corners.npz", corners=pixels())
    (tmp_path / "corners.vnl").write_text("# filename x y level\na.png 1 2 0\n")
    for name in ("corners.npz", "corners.vnl"):
        result = run("calibrate", tmp_path / name)
        refused(result, "but not their places on the board")
        assert result.stderr.endswith("give --board chessboard:COLSxROWS:SQUARE\n")


def test_the_wrong_board_is_named(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", pixels())
    result = run("convert", tmp_path / "a.npy", "--to", "neurocal", "--cols", 5, "--rows", 5, "--square", 1)
    assert result.exit_code == 1
    assert "there are 20 corners a view, and 5 x 5 vertices on the board" in result.stderr


@pytest.mark.parametrize("target", ["ros", "kalibr", "colmap"])
def test_programs_that_take_no_points_are_named(target: str, tmp_path: Path) -> None:
    write_points(points(pixels()), tmp_path / "points.csv")
    result = run("convert", tmp_path / "points.csv", "--to", target)
    refused(result, f"{target} has no file of points")


def test_mid_points_are_not_passed_on_silently(tmp_path: Path) -> None:
    ids = ["h:0:0", "h:1:0", "v:0:0", "v:1:0"]
    given = Correspondences(
        np.eye(4, 3), np.arange(8.0).reshape(4, 2), point=ids, across=np.tile([1.0, 0.0], (4, 1))
    )
    write_points(given, tmp_path / "points.csv")
    result = succeed("convert", tmp_path / "points.csv", "--to", "json", "-o", tmp_path / "a.json")
    assert "mid-points are measured in one direction only" in result.stderr
    assert len(json.loads((tmp_path / "a.json").read_text())["image_points"][0]) == 4
    result = run("convert", tmp_path / "points.csv", "--to", "mrcal")
    assert "mrcal takes the vertices of one flat board" in result.stderr


@pytest.mark.parametrize(
    ("target", "lost"),
    [
        ("json", "the image centre, sX,sY,sZ"),
        ("matlab", "the image centre, the ids of the points, sX,sY,sZ"),
        ("mrcal", "X,Y,Z, the unit, the image size, the image centre, sX,sY,sZ"),
    ],
)
def test_data_that_a_format_of_points_lacks_are_named(target: str, lost: str, tmp_path: Path) -> None:
    given = replace(points(pixels()), image_center=(320, 240), world_std=np.full((60, 3), 0.1))
    write_points(given, tmp_path / "points.csv")
    result = run("convert", tmp_path / "points.csv", "--to", target, "-o", tmp_path / "points.out")
    assert f"note: a file of points of {target} has no place for {lost}\n" in result.stderr


@settings(max_examples=50, deadline=None)
@given(
    target=st.sampled_from(["opencv", "matlab", "json", "npz", "mrcal"]),
    start=st.floats(0, 1),
    length=st.integers(0, 30),
    junk=st.binary(max_size=6),
)
def test_a_damaged_file_is_read_or_refused_in_one_line(
    target: str, start: float, length: int, junk: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    place = tmp_path_factory.getbasetemp() / "damaged-points"
    text = corner_text(points(pixels(1)), target, ".yaml")
    data = text.encode() if isinstance(text, str) else text
    k = int(start * len(data))
    place.write_bytes(data[:k] + junk + data[k + length :])
    message = ""
    try:
        read_corners([place], BOARD, [])
    except FormatError as error:
        message = str(error)
    assert message.isprintable()


def kept(form: str, seen: Array) -> object:
    """Points of views as PhotonVision or people keep them in JSON."""
    if form == "PhotonVision":
        spots = [dict(zip("xyz", X, strict=True)) for X in (WORLD / 1000).tolist()]
        views = [
            {
                "locationInObjectSpace": spots,
                "locationInImageSpace": [
                    dict(zip("xy", x, strict=True)) for x in np.nan_to_num(view, nan=-1).tolist()
                ],
                "snapshotName": f"im{k}",
            }
            for k, view in enumerate(seen)
        ]
        camera = {"rows": 3, "cols": 3, "data": [500, 0, 320, 0, 500, 240, 0, 0, 1]}
        return {
            "resolution": {"width": 640, "height": 480},
            "cameraIntrinsics": camera,
            "observations": views,
        }
    known = [np.isfinite(view).all(axis=1) for view in seen]
    parts = [(WORLD[here].tolist(), view[here].tolist()) for here, view in zip(known, seen, strict=True)]
    if form == "mapping":
        return {
            f"im{k}": {"object_points": X, "image_points": [[x] for x in u]} for k, (X, u) in enumerate(parts)
        }
    rows = [
        [{**dict(zip("XYZ", X, strict=True)), "u": u, "v": v} for X, (u, v) in zip(*part, strict=True)]
        for part in parts
    ]
    return [{"image": f"im{k}", "points": one} for k, one in enumerate(rows)]


@pytest.mark.parametrize("form", ["PhotonVision", "mapping", "list"])
def test_views_with_points_of_their_own_are_read(form: str, tmp_path: Path) -> None:
    seen = pixels()
    seen[0, 3] = np.nan
    (tmp_path / "a.json").write_text(json.dumps(kept(form, seen)))
    found = read_corners([tmp_path / "a.json"], None, [], what="points")
    assert found is not None
    assert np.array_equal(found.pixels, seen[np.isfinite(seen).all(axis=2)])
    assert found.view_names == ("im0", "im1", "im2")
    scale = 1000 if form == "PhotonVision" else 1
    assert np.abs(found.world * scale - np.tile(WORLD, (3, 1))[np.arange(60) != 3]).max() < 1e-9
    assert (found.unit, found.image_size) == (("m", (640, 480)) if scale == 1000 else ("unknown", None))


def test_pixels_by_the_names_of_views_share_the_places(tmp_path: Path) -> None:
    tree = {
        "object_points": WORLD.tolist(),
        "image_points": {f"b{k}": x.tolist() for k, x in enumerate(pixels())},
    }
    (tmp_path / "a.json").write_text(json.dumps(tree))
    found = read_corners([tmp_path / "a.json"], None, [])
    assert found is not None
    assert found.view_names == ("b0", "b1", "b2")
    assert np.array_equal(found.world, np.tile(WORLD, (3, 1)))


@pytest.mark.parametrize("shape", [(480, 640), (640, 480)])
def test_a_shape_that_the_pixels_do_not_fit_is_width_and_height(
    shape: tuple[int, int], tmp_path: Path
) -> None:
    seen = pixels() * [1, 0.7]
    seen[0, 0] = 601, 10
    np.savez(tmp_path / "a.npz", objpoints=[WORLD] * 3, imgpoints=seen, img_shape=shape)
    found = read_corners([tmp_path / "a.npz"], None, [])
    assert found is not None
    assert found.image_size == (640, 480)


@pytest.mark.parametrize(
    ("header", "order"),
    [
        ("image,X,Y,Z,x,y", [0, 1, 2, 3, 4]),
        ("image,x,y,z,u,v", [0, 1, 2, 3, 4]),
        ("image,X,Y,Z,row,col", [0, 1, 2, 4, 3]),
        ("image,x_mm,y_mm,z_mm,x_px,y_px", [0, 1, 2, 3, 4]),
        ("sep=,\nimage,X,Y,Z,u,v", [0, 1, 2, 3, 4]),
        ("# view X Y Z u v", [0, 1, 2, 3, 4]),
    ],
)
def test_columns_with_the_names_of_others_are_read(header: str, order: list[int], tmp_path: Path) -> None:
    row = [0.0, 25.0, 1.0, 300.5, 200.25]
    (tmp_path / "a.csv").write_text(f"{header}\na,{','.join(str(row[k]) for k in order)}\n")
    found = read_points(tmp_path / "a.csv")
    assert (found.world[0].tolist(), found.pixels[0].tolist(), found.unit) == (row[:3], row[3:], "mm")
    assert found.view_names == ("a",)


def test_a_file_without_points_is_no_table(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"foo": 1, "bar": 2, "baz": 3, "x": 4, "y": 5, "z": 6}')
    with pytest.raises(FormatError, match="is not a table of points, but a file of a camera"):
        read_points(tmp_path / "a.json")


def test_corners_of_other_programs_make_a_rig_with_their_board(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", pixels())
    write_points(points(pixels() + 1), tmp_path / "b.csv")
    found = read_rig_points([("", str(tmp_path / "a.npy")), ("", str(tmp_path / "b.csv"))], board=BOARD)
    assert list(found) == ["a", "b"]
    assert np.array_equal(found["a"].world, found["b"].world)
    assert found["a"].view_names == ("1", "2", "3")
    with pytest.raises(FormatError, match="give --board chessboard:COLSxROWS:SQUARE"):
        read_rig_points([("", str(tmp_path / "a.npy"))])


def test_a_grid_with_other_ids_is_a_board_of_mrcal() -> None:
    given = replace(points(pixels()), point=np.tile([f"p{k}" for k in range(20)], 3))
    lines = str(corner_text(given, "mrcal", "")).splitlines()
    assert len(lines) == 61
    assert lines == str(corner_text(points(pixels()), "mrcal", "")).splitlines()


def test_an_archive_without_arrays_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "points.zip", "w") as archive:
        archive.writestr("points.csv", "X,Y,Z,u,v\n")
    result = run("calibrate", tmp_path / "points.zip")
    refused(result, "is a ZIP archive without arrays of NumPy; unpack it first")


def test_a_table_is_one_of_points_whatever_the_order_of_its_columns(tmp_path: Path) -> None:
    rows = "".join(f"{8 * k + 1},{9 * k},0,{k},{2 * k % 7}\n" for k in range(12))
    (tmp_path / "a.csv").write_text(f"v,u,Z,Y,X\n{rows}")
    assert "12 points of 1 view" in run("convert", tmp_path / "a.csv", "--to", "neurocal").stderr


def test_points_by_their_place_on_the_board_need_the_board(tmp_path: Path) -> None:
    forms = {
        "row,col": lambda r, c: f"{r},{c}",
        "point": lambda r, c: f"{c}:{r}",
        "id": lambda r, c: f"{5 * r + c}",
    }
    forms |= {"row,col ": lambda r, c: f"{r + 1},{c + 1}", "corner_id": lambda r, c: f"{5 * r + c + 1}"}
    texts = set()
    for head, form in forms.items():
        rows = "".join(f"a,{form(r, c)},{c + 1},{r * c}\n" for r in range(4) for c in range(5))
        (tmp_path / "b.csv").write_text(f"view,{head},u,v\n{rows}")
        result = run("convert", tmp_path / "b.csv", "--to", "neurocal")
        assert ("or give --board chessboard" in result.stderr) == (head != "id")
        texts.add(run("convert", tmp_path / "b.csv", "--to", "neurocal", *SIZE).stdout)
    assert len(texts) == 1
    assert "a,4:3,100.0,75.0,0.0,5.0,12.0\n" in next(iter(texts))
    wrong = run("convert", tmp_path / "b.csv", "--to", "neurocal", "--board", "chessboard:4x3:25")
    assert "b.csv:14: is no vertex of a board of 4 x 3" in wrong.stderr
