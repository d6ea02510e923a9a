"""Points CSV: what is read, what is refused and with which words, and that nothing gets lost."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from neurocal_cli.errors import InputError, NeurocalError
from neurocal_cli.files.points_csv import POINTS, format_points, ids_at_two_places, read_points, write_points
from neurocal_cli.files.table import parse_table, read_in_bulk, read_line_by_line
from neurocal_cli.files.table_header import find_layout
from neurocal_cli.observations.points import Correspondences

CONTRACT = """\
# image_size: 640 480
# image_center: 320 240
# unit: mm
view,point,X,Y,Z,u,v
left01,h:0:0,12.5,0,0,301.21,118.40
left01,h:1:0,37.5,0,0,322.5,118
left02,h:0:0,12.5,0,0,300,110
"""


@pytest.fixture
def read(tmp_path):
    def read_text(*texts, notes=None, names=("a.csv", "b.csv", "c.csv")):
        paths = []
        for text, name in zip(texts, names, strict=False):
            path = tmp_path / name
            path.write_bytes(text if isinstance(text, bytes) else text.encode())
            paths.append(str(path))
        return read_points(paths[0] if len(paths) == 1 else paths, notes=notes)

    return read_text


def complaint(read, *texts):
    with pytest.raises(NeurocalError) as caught:
        read(*texts)
    message = str(caught.value)
    assert "\n" not in message
    return message.replace(str(Path(message.split(": ")[0]).parent) + "/", "")


def same(a, b):
    assert a.world.tobytes() == b.world.tobytes()
    assert a.pixels.tobytes() == b.pixels.tobytes()
    assert a.view_names == b.view_names
    assert np.array_equal(a.view_index, b.view_index)
    assert (a.point is None) == (b.point is None)
    assert a.point is None or list(map(str, a.point)) == list(map(str, b.point))
    assert (a.covariance is None) == (b.covariance is None)
    assert a.covariance is None or a.covariance.tobytes() == b.covariance.tobytes()
    assert (a.across is None) == (b.across is None)
    assert a.across is None or a.across.tobytes() == b.across.tobytes()
    assert (a.world_std is None) == (b.world_std is None)
    assert a.world_std is None or a.world_std.tobytes() == b.world_std.tobytes()
    assert (a.image_size, a.image_center, a.unit) == (b.image_size, b.image_center, b.unit)


def test_the_example_of_the_manual_is_read(read):
    points = read(CONTRACT)
    assert points.world.tolist() == [[12.5, 0, 0], [37.5, 0, 0], [12.5, 0, 0]]
    assert points.pixels.tolist() == [[301.21, 118.4], [322.5, 118], [300, 110]]
    assert points.view_names == ("left01", "left02")
    assert points.point.tolist() == ["h:0:0", "h:1:0", "h:0:0"]
    assert (points.image_size, points.image_center, points.unit) == ((640, 480), (320.0, 240.0), "mm")
    assert points.lines.tolist() == [5, 6, 7]


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_line_ends_and_a_byte_order_mark_make_no_difference(read, end, mark):
    same(read(mark + CONTRACT.replace("\n", end).encode()), read(CONTRACT))


@pytest.mark.parametrize("separator", [",", ", ", ";", "\t", " ", "   ", " \t "])
def test_commas_semicolons_tabs_and_blanks_separate(read, separator):
    same(read(CONTRACT.replace(",", separator)), read(CONTRACT))


def test_blank_lines_comments_and_quotes_make_no_difference_to_the_points(read):
    text = CONTRACT.replace("left01,h:1", '\n  \n# a remark\n"left01",h:1').replace(
        "view,point", '"view","point"'
    )
    points = read(text)
    same(points, read(CONTRACT))
    assert points.lines.tolist() == [5, 9, 10]


def test_columns_are_found_by_name_and_unknown_ones_left_out_with_a_note(read):
    notes = []
    points = read("v,u,quality,Z,Y,X\n1,2,good,3,4,5\n", notes=notes)
    assert points.world.tolist() == [[5, 4, 3]]
    assert points.pixels.tolist() == [[2, 1]]
    assert points.view is None
    assert len(notes) == 1
    assert "'quality'" in notes[0]


@pytest.mark.parametrize(
    ("comment", "noted"),
    [
        ("# units: cm", "for unit, write a name as in `# unit: mm`"),
        ("# unit = cm", "for unit, write"),
        ("# Image size: 640 480", "for image_size, write two whole numbers"),
        ("# image_centre: 320 240", "for image_center, write two numbers"),
        ("# image_file: left.png", ""),
        ("# measured by hand, with care: twice", ""),
    ],
)
def test_comments_that_are_nearly_metadata_are_noted(comment, noted, read):
    notes = []
    points = read(f"{comment}\nX,Y,Z,u,v\n1,2,3,4,5\n", notes=notes)
    assert (points.unit, points.image_size, points.image_center) == ("mm", None, None)
    assert len(notes) == bool(noted)
    assert noted in "".join(notes)


def test_an_id_at_two_places_is_noted_with_both_lines(read):
    points = read(f"{CONTRACT}left03,h:0:0,13,0,0,300,110\n")
    (note,) = ids_at_two_places(points)
    assert "a.csv:8: the point 'h:0:0' is at (13, 0, 0), but at (12.5, 0, 0) in" in note
    assert "a.csv:5; if all views show one target" in note


@pytest.mark.parametrize("text", [CONTRACT, CONTRACT.replace("left02,h:0:0,12.5,", "left02,h:0:0,12.50001,")])
def test_an_id_at_one_place_is_not_noted(read, text):
    """Up to the rounding of other programs."""
    assert ids_at_two_places(read(text)) == []


def test_five_columns_without_a_header_are_x_y_z_u_v(read):
    assert read("1 2 3 4 5\n6 7 8 9 10").pixels.tolist() == [[4, 5], [9, 10]]


@pytest.mark.parametrize(
    ("text", "advice"),
    [
        ("X,Y,Z,u,v\n1,5,2,5,3,5,4,5,5,5\n", "found 10; write decimal points"),
        ("1,5,2,5,3,5,4,5,5,5\n", "found 10; write decimal points"),
        ("x,Y,Z,px,v\n", "write x as X, and name the column u"),
    ],
)
def test_the_advice_fits_the_cause(read, text, advice):
    assert advice in complaint(read, text)


def test_a_commented_header_in_another_order_is_not_ignored(read):
    assert "remove its #" in complaint(read, "# u v X Y Z\n1 2 3 4 5\n")


def test_quoted_labels_may_hold_separators_and_quotes(read):
    points = read('view,X,Y,Z,u,v\n"a,b",1,2,3,4,5\n" ""c"" ",1,2,3,4,5\n')
    assert points.view_names == ("a,b", ' "c" ')


def test_labels_of_any_alphabet_are_read(read):
    assert read("view,X,Y,Z,u,v\né 1,1,2,3,4,5\n左,1,2,3,4,5\n").view_names == ("é 1", "左")


def test_a_direction_of_measurement_is_kept(read):
    points = read("X,Y,Z,u,v,nu,nv\n1,2,3,4,5,0.6,-0.8\n1,2,4,4,6,0,0\n")
    assert points.across.tolist() == [[0.6, -0.8], [0, 0]]
    assert read("X,Y,Z,u,v,nu,nv\n1,2,3,4,5,0,0\n").across is None


def test_files_with_and_without_directions_are_read_as_one(tmp_path):
    (tmp_path / "a.csv").write_text("X,Y,Z,u,v,nu,nv\n1,2,3,4,5,0,1\n")
    (tmp_path / "b.csv").write_text("X,Y,Z,u,v\n1,2,3,4,5\n")
    points = read_points([tmp_path / "a.csv", tmp_path / "b.csv"])
    assert points.across.tolist() == [[0, 1], [0, 0]]


def test_the_std_of_world_points_is_kept_and_0_where_a_file_has_none(tmp_path):
    (tmp_path / "a.csv").write_text("X,Y,Z,u,v,sX,sY,sZ\n1,2,3,4,5,0.1,0.2,0\n")
    (tmp_path / "b.csv").write_text("X,Y,Z,u,v\n1,2,3,4,5\n")
    points = read_points([tmp_path / "a.csv", tmp_path / "b.csv"])
    assert points.world_std.tolist() == [[0.1, 0.2, 0], [0, 0, 0]]
    assert read_points(tmp_path / "b.csv").world_std is None


def test_sigma_becomes_a_round_covariance(read):
    assert read("X,Y,Z,u,v,sigma\n1,2,3,4,5,0.5\n").covariance.tolist() == [[0.25, 0, 0.25]]
    assert read("X,Y,Z,u,v,suu,suv,svv\n1,2,3,4,5,2,1,3\n").covariance.tolist() == [[2, 1, 3]]


def test_a_view_may_come_back_later_in_the_same_file(read):
    points = read("view,X,Y,Z,u,v\na,1,2,3,4,5\nb,1,2,3,4,5\na,6,7,8,9,10\n")
    assert points.view_names == ("a", "b")
    assert points.view_index.tolist() == [0, 1, 0]


def test_several_files_are_read_as_one(read):
    points = read(CONTRACT, "X,Y,Z,u,v\n1,2,3,4,5\n", notes=(notes := []))
    assert points.view_names == ("left01", "left02", "b")
    assert points.image_size == (640, 480)
    assert points.point is None
    assert "no column point" in notes[0]
    assert points.place(1).endswith("a.csv:6")
    assert points.place(3).endswith("b.csv:2")
    assert points.select(np.array([3])).place(0).endswith("b.csv:2")


def test_a_constant_zoom_is_noted_and_a_varying_one_refused(read):
    notes = []
    read("X,Y,Z,u,v,zoom\n1,2,3,4,5,35\n2,2,3,4,5,35\n", notes=notes)
    assert "zoom is 35 throughout" in notes[0]
    message = complaint(read, "X,Y,Z,u,v,focus\n1,2,3,4,5,1\n2,2,3,4,5,2\n")
    assert message.startswith("a.csv:3: focus changes from 1 to 2")
    assert "give one setting" in message
    two_files = ("view,X,Y,Z,u,v,zoom\na,1,2,3,4,5,1\n", "view,X,Y,Z,u,v,zoom\nb,1,2,3,4,5,2\n")
    assert complaint(read, *two_files).startswith("b.csv:2: zoom changes")


FAULTS = {
    "": "a.csv: is empty",
    "\n\n# unit: mm\n": "a.csv: is empty",
    "X,Y,Z,u,v\n": "a.csv:1: there are no points below the header",
    "frame,camera,u,v\n1,2,3,4\n": "a.csv:1: columns X, Y, Z missing from the header 'view,camera,u,v'; "
    "name the columns X,Y,Z,u,v; points of unknown place, such as markers of a wand, do",
    "x,y,Z,u,v\n1,2,3,4,5\n": "a.csv:1: columns X, Y missing from the header 'x,y,Z,u,v'; write x as X",
    "view,X,Y,u,v\na,1,2,3,4\n": "a.csv:1: column Z missing",
    "left,h:0:0,12.5,0,0,301,118\n": "a.csv:1: there is no header, but 'left,h:0:0,12.5,0,0,",
    "X,Y,Z,u,v,u\n1,2,3,4,5,6\n": "a.csv:1: the column u appears twice",
    "1,2,3,4\n": "a.csv:1: there is no header, so 5 columns X,Y,Z,u,v are expected, found 4",
    "1,2,3,4,5,6\n": "a.csv:1: there is no header",
    "X,Y,Z,u,v\n1,2,3,4\n": "a.csv:2: expected 5 values (X,Y,Z,u,v), found 4",
    "X,Y,Z,u,v\n1,2,3,4,5\n1,2,3,4,5,6\n": "a.csv:3: expected 5 values (X,Y,Z,u,v), found 6",
    "X,Y,Z,u,v\n\n1,2,3,4,five\n": "a.csv:3: v is 'five', not a number",
    "X,Y,Z,u,v\n1,2,3,4,\n": "a.csv:2: v is empty",
    "X,Y,Z,u,v\n1,2,3,nan,5\n": "a.csv:2: u is nan, but must be a finite number",
    "X,Y,Z,u,v\n1,2,-inf,4,5\n": "a.csv:2: Z is -inf, but must be a finite number",
    "X,Y,Z,u,v\n1,2,3,4,1e999\n": "a.csv:2: v is 1e999, but must be a finite number",
    "X,Y,Z,u,v\n1,2,3,4,5\n1,2,1e308,4,5\n": "a.csv:3: X,Y,Z must be finite numbers of a sensible size",
    "X,Y,Z,u,v\n1,2,3,4,1_0\n": "a.csv:2: v is '1_0', not a number",
    "X,Y,Z,u,v\n1,2,3,4,0x10\n": "a.csv:2: v is '0x10', not a number",
    "X;Y;Z;u;v\n1;2;3;4,5;5\n": "a.csv:2: u is '4,5', with a decimal comma; write 4.5",
    "1,5;2,5;3,5;4,5;5,5\n": "a.csv:1: '1,5' has a decimal comma; write 1.5",
    "X,Y,Z,u,v,sigma\n1,2,3,4,5,0\n": "a.csv:2: sigma is 0, but must be positive",
    "X,Y,Z,u,v,sigma\n1,2,3,4,5,1e-300\n": "a.csv:2: the pixel's covariance",
    "X,Y,Z,u,v,sigma\n1,2,3,4,5,1e200\n": "a.csv:2: the pixel's covariance",
    "X,Y,Z,u,v,suu,suv,svv\n1,2,3,4,5,1,2,1\n": "a.csv:2: the pixel's covariance",
    "X,Y,Z,u,v,suu\n1,2,3,4,5,1\n": "a.csv: has suu only",
    "X,Y,Z,u,v,sZ\n1,2,3,4,5,1\n": "a.csv: has sZ only; give all of sX,sY,sZ",
    "X,Y,Z,u,v,sX,sY,sZ\n1,2,3,4,5,1,-1,1\n": "a.csv:2: the world point's standard deviation sX,sY,sZ",
    "X,Y,Z,u,v,nu\n1,2,3,4,5,1\n": "a.csv: has nu only; give both nu,nv",
    "X,Y,Z,u,v,nu,nv\n1,2,3,4,5,1,1e200\n": "a.csv:2: the direction nu,nv in which the point was measured",
    "X,Y,Z,u,v,sigma,suu,suv,svv\n1,2,3,4,5,1,1,0,1\n": "a.csv: has both sigma and suu,suv,svv",
    "view,X,Y,Z,u,v\n,1,2,3,4,5\n": "a.csv:2: view is empty",
    'view,X,Y,Z,u,v\n"a,1,2,3,4,5\n': 'a.csv:2: a quote (") is not closed',
    '"view,X,Y,Z,u,v\n': 'a.csv:1: a quote (") is not closed',
    "# image_size: 640x480\nX,Y,Z,u,v\n1,2,3,4,5\n": "a.csv:1: image_size is '640x480'; write two",
    "# image_size: 0 480\nX,Y,Z,u,v\n1,2,3,4,5\n": "a.csv:1: image_size is '0 480'",
    "# image_center: 1 nan\nX,Y,Z,u,v\n1,2,3,4,5\n": "a.csv:1: image_center is '1 nan'; write two numbers",
    "# unit:\nX,Y,Z,u,v\n1,2,3,4,5\n": "a.csv:1: unit is ''",
    "# unit: mm\nX,Y,Z,u,v\n# unit: cm\n1,2,3,4,5\n": "a.csv:3: unit is given twice and differs",
    "view,point,X,Y,Z,u,v\na,p,1,2,3,4,5\nb,p,1,2,3,4,5\na,p,6,7,8,9,9\n": (
        "a.csv:4: the point 'p' is already on line 2 in the view 'a'; remove one of the rows"
    ),
    "point,X,Y,Z,u,v\np,1,2,3,4,5\np,1,2,3,4,5\n": "a.csv:3: the point 'p' is already on line 2; remove",
}


@pytest.mark.parametrize("text", FAULTS, ids=[v.split(": ", 1)[1][:40] for v in FAULTS.values()])
def test_a_fault_is_named_with_file_line_and_remedy(read, text):
    assert complaint(read, text).startswith(FAULTS[text])


def test_files_that_are_not_utf8_text_are_refused(read):
    assert "is UTF-16 text; save it as UTF-8" in complaint(read, CONTRACT.encode("utf-16"))
    assert "is UTF-16 text" in complaint(read, CONTRACT.encode("utf-16-le"))
    assert "is UTF-32 text" in complaint(read, CONTRACT.encode("utf-32"))
    assert "is an image, not a CSV file of points; find its points first: `neurocal detect" in complaint(
        read, b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\2\x80"
    )
    assert "is a video, not a CSV file of points; find its points first: `neurocal detect" in complaint(
        read, b"\0\0\0\x20ftypisom\0\0\2\0isomiso2"
    )
    assert complaint(read, b"X,Y,Z,u,v\n1,2,3,4,5\xe9\n").startswith("a.csv:2: byte 0xe9 is not UTF-8")


def test_a_view_in_two_files_is_refused_with_both_names(read):
    message = complaint(read, CONTRACT, CONTRACT)
    assert message.startswith("b.csv:5: the view 'left01' is also in ")
    assert "a.csv" in message


@pytest.mark.parametrize("key", ["image_size: 9 9", "image_center: 9 9", "unit: cm"])
def test_files_of_one_camera_must_agree_on_it(read, key):
    other = f"# {key}\nview,X,Y,Z,u,v\nother,1,2,3,4,5\n"
    assert complaint(read, CONTRACT, other).startswith(f"b.csv: {key.split(':')[0]} is ")


def test_accuracy_must_be_given_for_all_files_or_none(read):
    message = complaint(read, CONTRACT, "view,X,Y,Z,u,v,sigma\nother,1,2,3,4,5,1\n")
    assert message.startswith("a.csv: has no sigma")


def test_no_files_are_an_input_error():
    with pytest.raises(InputError, match="no files"):
        read_points([])


def test_a_path_may_be_bytes(tmp_path):
    (tmp_path / "a.csv").write_text(CONTRACT)
    assert len(read_points(os.fsencode(tmp_path / "a.csv"))) == len(read_points(tmp_path / "a.csv"))


def test_a_label_with_a_line_break_is_not_written():
    points = Correspondences([[1, 2, 3]], [[4, 5]], view=["a\nb"])
    with pytest.raises(InputError, match="rename it"):
        format_points(points)


LABELS = st.text(
    st.characters(exclude_categories=("Cs",), exclude_characters="\0\r\n"), min_size=1, max_size=8
)
NUMBERS = st.floats(-1e99, 1e99)
COORDINATES = NUMBERS.filter(lambda x: x == 0 or abs(x) > 1e-99)  # smaller ones are refused


@st.composite
def correspondences(draw):
    n = draw(st.integers(1, 5))
    variances = arrays(float, (n, 2), elements=st.floats(1e-50, 1e50))
    covariance = None
    if draw(st.booleans()):
        suu, svv = draw(variances).T
        covariance = np.column_stack([suu, draw(st.floats(-0.9, 0.9)) * np.sqrt(suu * svv), svv])
    views = draw(st.none() | st.lists(LABELS, min_size=n, max_size=n))
    ids = draw(st.none() | st.lists(LABELS, min_size=n, max_size=n, unique=True))
    return Correspondences(
        draw(arrays(float, (n, 3), elements=COORDINATES)),
        draw(arrays(float, (n, 2), elements=NUMBERS)),
        view=views,
        point=ids,
        covariance=covariance,
        across=draw(st.none() | arrays(float, (n, 2), elements=NUMBERS)),
        world_std=draw(st.none() | arrays(float, (n, 3), elements=st.floats(0, 1e99))),
        image_size=draw(st.none() | st.tuples(st.integers(1, 99999), st.integers(1, 99999))),
        image_center=draw(st.none() | st.tuples(NUMBERS, NUMBERS)),
        unit=draw(st.sampled_from(["mm", "m", "square", "µm", "my unit"])),
    )


@settings(max_examples=40, deadline=None)
@given(points=correspondences())
def test_points_come_back_from_csv_to_the_last_bit(tmp_path_factory, points):
    path = tmp_path_factory.getbasetemp() / "points.csv"
    write_points(points, path)
    same(read_points(path), points)


CELLS = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.integers(-(10**20), 10**20).map(str),
    st.sampled_from(
        ["1.", ".5", "+1", "-0", "1e5", "1E-5", "1e400", "1e-400", "1_0", "0x1", "nan", "inf", "1e"]
    ),
    st.sampled_from(
        ["1d5", "-", ".", "\u0663", "\uff11", "1\u00a0", "\x0b1", "\x1c1", "1,5", "a;b", "\u00e9"]
    ),
    st.sampled_from(["", " ", "# 1", '"1"', '"a,b"', "1 2", "a b", " a", "a ", "1\t"]),
    st.text(st.characters(exclude_categories=("Cs",)), max_size=3),
)
TAIL = st.sampled_from(["\n", "\n", "\n", "\n\n", "\r\n", "\r", " \n", ""])


@st.composite
def tables(draw):
    separator = draw(st.sampled_from([",", ", ", ";", "\t", " "]))
    names = draw(
        st.permutations(["X", "Y", "Z", "u", "v", *draw(st.sets(st.sampled_from(["view", "point", "q"])))])
    )
    plain = draw(st.booleans())  # mostly right, or else the fast reader is never the one
    lines = [separator.join(names) + draw(TAIL)]
    for _ in range(draw(st.integers(0, 4))):
        cells = [draw(CELLS if not plain else st.integers(-99, 99).map(str)) for _ in names]
        lines.append(separator.join(cells[: draw(st.sampled_from([None, None, None, -1]))]) + draw(TAIL))
    return "".join(lines).encode()


@settings(max_examples=60, deadline=None)
@given(data=tables())
def test_the_fast_reader_agrees_with_the_careful_one_or_steps_aside(data):
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    try:
        layout = find_layout(data, "t.csv", POINTS)
    except NeurocalError:
        return
    fast = read_in_bulk(data, "t.csv", POINTS, layout)
    if fast is None:
        return
    careful = read_line_by_line(data, "t.csv", POINTS, layout)  # must not raise
    for name, column in careful.numbers.items():
        assert fast.numbers[name].tobytes() == column.tobytes()
    for name, column in careful.labels.items():
        assert np.array_equal(fast.labels[name], column)
        assert fast.labels[name].dtype == column.dtype
    assert np.array_equal(fast.lines, careful.lines)


def test_the_fast_reader_takes_every_plain_file():
    for separator in (",", ";", "\t", " "):
        data = CONTRACT.replace(",", separator).encode()
        layout = find_layout(data, "t.csv", POINTS)
        assert read_in_bulk(data, "t.csv", POINTS, layout) is not None


def test_labels_longer_than_those_at_both_ends_are_not_cut_off():
    short, long = "a,1,2,3,4,5\n", "a-rather-long-name,1,2,3,4,5\n"
    data = ("view,X,Y,Z,u,v\n" + short * 8000 + long + short * 8000).encode()
    layout = find_layout(data, "t.csv", POINTS)
    fast = read_in_bulk(data, "t.csv", POINTS, layout)
    assert fast.labels["view"][8000] == "a-rather-long-name"


@settings(max_examples=40, deadline=None)
@given(
    data=tables() | st.binary(max_size=80) | st.text(max_size=60).map(lambda s: s.encode("utf-8", "replace"))
)
def test_any_junk_is_read_or_refused_in_one_line(data):
    message = "junk.csv"
    try:
        assert len(parse_table(data, "junk.csv", POINTS)) > 0
    except NeurocalError as error:
        message = str(error)
    assert message.startswith("junk.csv")
    assert message.isprintable()


@pytest.mark.slow
def test_a_million_columns_do_not_hang(tmp_path: Path) -> None:
    """Comparing each name with all others would take hours."""
    file = tmp_path / "wide.csv"
    names = ",".join(f"c{k}" for k in range(1_000_000))
    file.write_text(f"{names}\n{'1,' * 999_999}1\n")
    with pytest.raises(NeurocalError, match="columns X, Y, Z, u, v missing"):
        read_points(file)
