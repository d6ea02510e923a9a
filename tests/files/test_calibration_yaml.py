"""Calibration files: they give back every number, and junk is refused in one line."""

from __future__ import annotations

import random
import re
from contextlib import nullcontext
from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.made_calibration import made_calibration

from neurocal_cli.calibration.calibration import Calibration, NetworkRecord, Rejected, ViewResult
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, POSE_NAMES, Intrinsics, Pose
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.calibration_yaml import calibration_lines, format_calibration, read_calibration
from neurocal_cli.files.result_files import write_calibration
from neurocal_cli.files.yaml_text import number, parse_yaml, quoted, text
from neurocal_cli.observations.points import Correspondences

# Without NUL, which NumPy drops at the end of a label.
NAMES = st.text(
    st.characters(exclude_categories=("Cs",), exclude_characters="\0"), min_size=1, max_size=12
) | st.sampled_from(
    [
        "1e5",
        "0E0",
        "1.5e5",
        "-.5",
        "1e-05",
        "null",
        "- x",
        "true",
        "no",
        "~",
        "012",
        "0x1F",
        "1_000",
        "12:30",
        "2001-01-01",
        "a: b",
        "#",
    ]
)
FINITE = st.floats(allow_nan=False, allow_infinity=False)
# Smaller worlds are refused.
COORDINATES = st.floats(-1e90, 1e90).map(lambda x: x if abs(x) > 1e-90 else 0.0)
UNKNOWN = st.floats(0, 1e300) | st.just(float("nan"))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cal.yaml"


@pytest.fixture(scope="module")
def good():
    return format_calibration(made_calibration(2))


def read(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_calibration(path)


def same(a, b):
    """Whether two values are equal to the last bit, whatever they are made of."""
    if isinstance(a, (np.ndarray, float)) and not isinstance(a, bool):
        a, b = np.asarray(a), np.asarray(b)
        if a.dtype.kind == "f":
            missing = np.isnan(a)
            filled = a.shape == b.shape and np.array_equal(missing, np.isnan(b))
            return filled and np.where(missing, 0, a).tobytes() == np.where(missing, 0, b).tobytes()
        return list(map(str, a)) == list(map(str, b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, Correspondences):
        names = [f.name for f in fields(a) if f.name not in ("source", "lines", "sources", "view")]
        return all(same(getattr(a, name), getattr(b, name)) for name in names)
    if isinstance(a, (Calibration, Rejected, ViewResult, NetworkRecord, Pose)):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return a == b


@st.composite
def rejections(draw, points):
    views = draw(st.dictionaries(NAMES, NAMES, max_size=2))
    if draw(st.booleans()):
        return Rejected(views=views)
    lines = np.arange(7, 7 + len(points)) if draw(st.booleans()) else None
    return Rejected(
        replace(points, covariance=None, across=None, image_size=None, image_center=None, lines=lines),
        np.where(np.arange(len(points)) % 2, np.nan, 3.5),
        views,
    )


@st.composite
def calibrations(draw):
    names = draw(st.lists(NAMES, min_size=1, max_size=3, unique=True))
    n = draw(st.integers(len(names), 5))
    labels = names + [draw(st.sampled_from(names)) for _ in range(n - len(names))]
    values = np.array(draw(st.lists(COORDINATES, min_size=5 * n, max_size=5 * n))).reshape(n, 5)
    points = Correspondences(
        values[:, :3],
        values[:, 3:],
        labels,
        image_size=draw(st.none() | st.just((640, 480))),
        image_center=draw(st.none() | st.tuples(COORDINATES, COORDINATES)),
        point=draw(st.none() | st.lists(NAMES, min_size=n, max_size=n, unique=True)),
        covariance=draw(st.none() | st.just(np.tile([0.1 + 0.2, 1e-5, 1.0], (n, 1)))),
        across=draw(st.none() | st.just(np.tile([0.1 + 0.2, -1e-5], (n, 1)))),
        unit=draw(NAMES),
    )
    angles, shifts = st.floats(-1.5, 1.5), st.floats(-1e9, 1e9)
    some = draw(st.sampled_from([INTRINSIC_NAMES, INTRINSIC_NAMES[:2], ()]))
    views = {
        name: ViewResult(
            Pose.from_euler(*(draw(angles) for _ in range(3)), np.array([draw(shifts) for _ in range(3)])),
            dict(zip(POSE_NAMES, draw(st.lists(UNKNOWN, max_size=6)), strict=False)),
            draw(st.integers(0, 100)),
            draw(UNKNOWN),
            draw(st.booleans()),
        )
        for name in names
    }
    network = NetworkRecord(
        np.array([draw(FINITE) for _ in range(9)]).reshape(3, 3),
        {name: np.full((3, 4), draw(FINITE)) for name in names},
        np.eye(3),
        {name: np.full((4, 4), draw(FINITE)) for name in names},
        *(3, 2, 100, 5),
        *(draw(UNKNOWN), draw(UNKNOWN), draw(UNKNOWN)),
        tuple(draw(st.lists(UNKNOWN, max_size=3))),
    )
    model, size = draw(
        st.sampled_from(
            [("none", 0), ("k1", 1), ("k1k2", 2), ("k1k2p1p2", 4), ("plumb_bob", 5), ("rational", 8)]
        )
    )
    return Calibration(
        intrinsics=Intrinsics(
            draw(st.floats(1, 1e6)), draw(st.floats(1, 1e6)), 0.1, -0.0, draw(st.floats(1, 2))
        ),
        std={name: 0.0 if name in some else 0.1 for name in INTRINSIC_NAMES},
        fixed=frozenset(some),
        views=views,
        points=points,
        type=draw(st.integers(1, 4)),
        method="neuro",
        trainer="lm",
        seed=draw(st.integers(0, 2**40)),
        converged=draw(st.booleans()),
        stop_reason="converged: the reprojection error is at a minimum",
        rmse_px=draw(UNKNOWN),
        max_px=0.3,
        rejected=draw(rejections(points)),
        lens_choice=draw(st.just({}) | st.just({"none": 1.25, "k1": float("nan")})),
        target_stretched=draw(st.sampled_from([0.0, 0.1 + 0.2])),
        distortion_model=model,
        distortion=np.array([draw(st.floats(0.1, 1)) for _ in range(size)]),
        covariance=np.array([[1e-5, -0.0], [float("nan"), 0.1]]),
        covariance_names=("alpha_u", "v0"),
        network=draw(st.none() | st.just(network)),
        camera_name=draw(NAMES),
        warnings=tuple(draw(st.lists(NAMES, max_size=2))),
    )


@settings(max_examples=25, deadline=None)
@given(cal=calibrations())
def test_a_calibration_comes_back_to_the_last_bit(tmp_path_factory, cal):
    path = tmp_path_factory.getbasetemp() / "cal.yaml"
    write_calibration(cal, path)
    back = read_calibration(path)
    assert same(cal, back)
    assert cal.K.tobytes() == back.K.tobytes()
    assert format_calibration(back) == format_calibration(cal)


@pytest.fixture
def all_files_are_long():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neurocal_cli.files.calibration_yaml._MOST_POINTS", 0)
        patch.setattr("neurocal_cli.files.key_tables.LONGEST", 2)
        patch.setattr("neurocal_cli.files.calibration_blocks.LONGEST", 2)
        yield


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cal=calibrations())
def test_so_does_one_whose_tables_are_columns(tmp_path_factory, all_files_are_long, cal):
    path = tmp_path_factory.getbasetemp() / "cal.yaml"
    known = dict.fromkeys(POSE_NAMES[:4], 0.5)
    cal = replace(cal, views={name: replace(view, std=known) for name, view in cal.views.items()})
    write_calibration(cal, path)
    assert yaml.load(path.read_text(), yaml.CSafeLoader)["neurocal"]["format"] == 2
    assert same(cal, read_calibration(path))
    assert format_calibration(cal, by_rows=True).count("format: 1") == 1


@settings(max_examples=12, deadline=None)
@given(cal=calibrations(), style=st.sampled_from([None, True, False]), slow=st.booleans())
def test_a_file_written_anew_by_another_program_reads_the_same(tmp_path_factory, cal, style, slow):
    path = tmp_path_factory.getbasetemp() / "cal.yaml"
    tree = yaml.load(format_calibration(cal), yaml.SafeLoader if slow else yaml.CSafeLoader)
    dumper = yaml.SafeDumper if slow else yaml.CSafeDumper
    dumper = type("Plain", (dumper,), {"ignore_aliases": lambda self, data: True})
    again = yaml.dump(tree, Dumper=dumper, default_flow_style=style, sort_keys=False)
    assert same(cal, read(path, again))


@given(value=FINITE)
def test_every_number_is_read_exactly_by_any_yaml_parser(value):
    back = yaml.safe_load(number(value))
    assert isinstance(back, float)
    assert np.float64(back).tobytes() == np.float64(value).tobytes()
    assert np.float64(parse_yaml(f"x: {number(value)}", "f")["x"]).tobytes() == np.float64(value).tobytes()


@given(value=NAMES)
def test_every_name_is_read_exactly_by_any_yaml_parser(value):
    for written in (text(value), quoted(value)):
        for loader in (yaml.SafeLoader, yaml.CSafeLoader):
            assert yaml.load(f"{written}: {written}", loader) == {value: value}
        assert parse_yaml(f"{written}: [{written}]", "f") == {value: [value]}


def test_half_a_character_is_refused():
    with pytest.raises(InputError, match="rename it"):
        quoted("\ud800")


def test_the_file_is_a_ros_camera_info_with_the_keys_in_order(good):
    tree = yaml.safe_load(good)
    assert list(tree) == [
        *("camera_name", "image_width", "image_height", "camera_matrix", "distortion_model"),
        *("distortion_coefficients", "rectification_matrix", "projection_matrix", "neurocal"),
    ]
    cal = made_calibration(2)
    assert tree["camera_matrix"] == {"rows": 3, "cols": 3, "data": cal.K.ravel().tolist()}
    assert tree["distortion_coefficients"] == {"rows": 1, "cols": 5, "data": [0.0] * 5}
    assert np.reshape(tree["projection_matrix"]["data"], (3, 4))[:, :3].tolist() == cal.K.tolist()
    block = tree["neurocal"]
    keys = ["format", "type", "method", "trainer", "seed", "converged", "stop_reason", "unit", "parameters"]
    keys += ["fit", "views", "network", "observations"]
    assert [key for key in block if key in keys] == keys
    assert block["parameters"]["alpha_u"] == {"value": 600.0, "std": 0.43}
    assert list(block["fit"]) == ["n_points", "n_rejected", "rmse_px", "max_px"]
    view = block["views"][0]
    assert list(view["rotation"]) == ["R_x", "R_y", "R_z"]
    assert list(view["translation"]["t_x"]) == ["value", "std"]
    P = cal.projections["view00"]
    assert np.allclose(view["projection_matrix"], P, rtol=1e-14)
    assert block["observations"]["columns"] == ["view", "X", "Y", "Z", "u", "v"]
    assert len(block["observations"]["rows"]) == len(cal.points)


def test_given_parameters_have_no_deviation_and_are_marked(path):
    cal = replace(made_calibration(), fixed=frozenset(["u0", "v0"]))
    tree = yaml.safe_load(format_calibration(cal))
    assert tree["neurocal"]["parameters"]["u0"] == {"value": 320.0, "std": 0, "fixed": True}
    write_calibration(cal, path)
    assert read_calibration(path).fixed == {"u0", "v0"}


def test_accuracy_of_distortion_stands_with_the_parameters(path):
    cal = replace(made_calibration(), distortion_model="k1k2", distortion=np.array([0.1, 0.2]))
    cal = replace(cal, std={**cal.std, "k1": 0.01, "k2": 0.02})
    write_calibration(cal, path)
    assert "k2: {value: 0.2, std: 0.02}" in path.read_text()
    assert same(read_calibration(path), cal)


def test_an_unknown_image_size_is_zero_to_ros_and_none_to_us(path):
    cal = made_calibration()
    cal = replace(cal, points=replace(cal.points, image_size=None))
    write_calibration(cal, path)
    assert "image_width: 0\n" in path.read_text()
    assert read_calibration(path).image_size is None


def test_the_text_may_be_indented_into_another_file(path):
    content = "\n".join([*calibration_lines(made_calibration(2)), ""])
    rig = "left:\n" + re.sub("^", "  ", content, flags=re.MULTILINE).rstrip(" ")
    assert parse_yaml(rig, "rig")["left"] == parse_yaml(content, "cal")


def test_rows_that_only_look_like_json_are_left_to_yaml():
    template = "observations:\n  columns: [a]\n  rows:\n  - [{}]\n  - [2]\nafter: 1\n"
    for cell in ("NaN", "left", "'x'", "1,", "1 # 2"):
        loaded = yaml.safe_load(template.format(cell).replace("# 2", "]# 2"))
        assert parse_yaml(template.format(cell).replace("# 2", "]# 2"), "f") == loaded


@pytest.mark.parametrize("row", ["1], 5, [2", "1],[2", "1, [2", "1]]"])
def test_brackets_that_do_not_pair_up_in_a_row_are_a_syntax_error(row):
    with pytest.raises(FormatError, match="not valid YAML"):
        parse_yaml(f"observations:\n  columns: [a]\n  rows:\n  - [{row}]\n  - [3]\n", "f")


def test_the_line_of_a_syntax_error_below_the_rows_is_named(path, good):
    with pytest.raises(FormatError, match=rf"cal.yaml:{good.count(chr(10)) + 1}: is not valid YAML"):
        read(path, good + "]\n")


def complaint(path, content):
    with pytest.raises(FormatError) as caught:
        read(path, content)
    assert str(caught.value).isprintable()
    return str(caught.value).split("cal.yaml", 1)[1]


FAULTS = [
    (r"\A[\s\S]*", "", ": is empty; give a file that calibrate wrote"),
    (r"\A[\s\S]*", "view,X,Y,Z,u,v\na,1,2,3,4,5\n", ": is a table of points; calibrate first"),
    (r"\A[\s\S]*", "[1, 2]", ": is not a calibration; give a file"),
    (r"\A[\s\S]*", "a: b", ": has no neurocal block; give a file"),
    (r"\A[\s\S]*", "left: {a: 1}\nstereo: {a: 1}", ": is a stereo rig; give the file of one camera"),
    (
        r"neurocal:[\s\S]*",
        "",
        ": has no neurocal block, so the poses and points are missing; it can serve as --in",
    ),
    (r"format: 1", "format: 3", ": neurocal.format is 3, not 1 or 2; update neurocal"),
    (r"type: 1\n", "type: 5\n", ": neurocal.type must be 1, 2, 3 or 4, found 5"),
    (r"seed: 0", "seed: -1", ": neurocal.seed must be a whole number, 0 or more, found -1"),
    (r"converged: true", "converged: perhaps", ": neurocal.converged must be true or false, found 'perhaps'"),
    (
        r"alpha_u: {value: 600.0",
        "alpha_u: {value: big",
        ": neurocal.parameters.alpha_u.value must be a finite",
    ),
    (
        r"alpha_u: {value: 600.0",
        "alpha_u: {value: .nan",
        ": neurocal.parameters.alpha_u.value must be a finite",
    ),
    (
        r"alpha_u: {value: 600.0",
        "alpha_u: {value: -600",
        ": neurocal.parameters: alpha_u and alpha_v must be pos",
    ),
    (r"alpha_u: {value: 600.0", "alpha_u: {value: 601", ": camera_matrix and neurocal.parameters disagree"),
    (r"    alpha_v: .*\n", "", ": the key neurocal.parameters.alpha_v is missing"),
    (r"name: view01", "name: view00", ": neurocal.views[1].name must be a name that no other view has"),
    (r"name: view01", "name: other", ": neurocal.observations: the view 'view01' is not in neurocal.views"),
    (r" R: \[\[", " R: [[1", ": neurocal.views[0]: R and rotation disagree"),
    (r" R: \[\[.*", " R: [[1, 2]]", ": neurocal.views[0].R must be 3 x 3 finite numbers"),
    (
        r"n_points: 380",
        "n_points: 381",
        ": fit.n_points is 381, but there are 380 observations: the file is incomp",
    ),
    (
        r"columns: .*",
        "columns: [view, X, Y]",
        ": neurocal.observations.columns must be a list of different names",
    ),
    (
        r"columns: \[view,",
        "columns: [vieuw,",
        ": neurocal.observations.columns must be names among view, point, X, Y, Z",
    ),
    (
        r'\["view00", 0.0, ',
        '["view00", "zero", ',
        ": neurocal.observations.rows, column X, must be n finite numbers",
    ),
    (r'\["view00", 0.0, ', '["view00", 1e300, ', ", row 1: X,Y,Z must be finite numbers of a"),
    (r'\["view00", 0.0, ', '["view00", ', ": neurocal.observations.rows[0] must be a list of 6 values"),
    (r"rows:\n[\s\S]*", "rows: []\n", ": neurocal.observations.rows must be at least one row"),
    (r"type: 1\n", "type: 1\n  type: 1\n", ":15: the key 'type' appears twice"),
    (r"type: 1\n", "type: &a 1\n  other: *a\n", ":15: aliases (*name) are not read"),
    (r"distortion: none", "distortion: bent", ": neurocal.distortion: distortion model 'bent' is unknown"),
]


@pytest.mark.parametrize(("pattern", "replacement", "expected"), FAULTS, ids=[f[2][:50] for f in FAULTS])
def test_a_fault_is_named_with_its_key_and_remedy(path, good, pattern, replacement, expected):
    content, count = re.subn(pattern, lambda _: replacement, good, count=1)
    assert count == 1
    assert complaint(path, content).startswith(expected)


LONG_FAULTS = [
    (r"R_x: \['", "R_x: ['9,", ": neurocal.views must be columns of one length"),
    (r"R_x: \['", "R_x: ['1e999,", ": neurocal.views must be columns of one length"),
    (r"R_x: \['2", "R_x: ['x2", ": neurocal.views.R_x[0] must be numbers with commas between them"),
    (r"R_x: \['2", "R_x: ['3", ": neurocal.views: R11 to R33 and R_x, R_y, R_z disagree"),
    (r"R_x: \['2\.5", "R_x: ['null", ": neurocal.views, column R_x, must be n finite numbers"),
    (r"    rmse_px: .*\n", "", ": the key neurocal.views.rmse_px is missing"),
    (r'name: \["view00", "view01', 'name: ["view00", "view00', ": neurocal.views.name must be names that"),
    (r'name: \["view00", "view01', 'name: ["view00", "other', ": neurocal.observations: the view 'view01'"),
    (r"'0-159'", "'0-200'", ": neurocal.observations.views[0][1] must be numbers below 190"),
    (r"'0-159'", "'0-15'", ": neurocal.observations.views[0][2] must be 16 numbers"),
    (r"'0-159'", "'all'", ": neurocal.observations.views[0][1] must be whole numbers and ranges"),
    (r"'0-159', ", "", ": neurocal.observations.views[0] must be a list of 4 texts"),
    (r"      Y: .*\n", "", ": neurocal.observations.places must be the columns X, Y, Z"),
    (r"data: \['1\.0,", "data: ['", ": neurocal.network.V.data must be 24 finite numbers"),
]


@pytest.mark.parametrize(
    ("pattern", "replacement", "expected"), LONG_FAULTS, ids=[f[2][:50] for f in LONG_FAULTS]
)
def test_a_fault_in_columns_is_named_too(path, monkeypatch, pattern, replacement, expected):
    monkeypatch.setattr("neurocal_cli.files.calibration_yaml._MOST_POINTS", 0)
    content, count = re.subn(pattern, lambda _: replacement, format_calibration(made_calibration(2)), count=1)
    assert count == 1
    assert complaint(path, content).startswith(expected)


def test_a_billion_laughs_are_not_laughed(path):
    bomb = "a0: &a0 [x]\n" + "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 30))
    assert "aliases" in complaint(path, bomb)


def test_deep_nesting_is_refused(path):
    assert "nested too deeply" in complaint(path, "[" * 5000)
    assert "nested too deeply" in complaint(path, "{a: " * 5000)
    assert "nested too deeply" in complaint(path, "[" * 50)


def test_a_second_document_is_refused(path, good):
    assert "a second YAML document" in complaint(path, good + "---\na: 1\n")


def refused_or_read(path, content):
    message = ""
    try:
        read(path, content)
    except FormatError as error:
        message = str(error)
    assert message.isprintable()


@settings(max_examples=50, deadline=None)
@given(junk=st.binary(max_size=60) | st.text(max_size=60).map(lambda s: s.encode("utf-8", "replace")))
def test_random_bytes_are_refused_in_one_line(tmp_path_factory, junk):
    refused_or_read(tmp_path_factory.getbasetemp() / "cal.yaml", junk)


def test_a_truncated_file_is_refused_wherever_it_ends(path):
    cal = made_calibration()
    content = format_calibration(replace(cal, points=cal.points.select(slice(0, 6))))
    for end in range(0, len(content) - 2, 7):
        assert complaint(path, content[:end])


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4)
TREES = st.recursive(
    SCALARS,
    lambda t: st.lists(t, max_size=3) | st.dictionaries(st.text(max_size=3), t, max_size=3),
    max_leaves=6,
)


@cache
def of_four_points():
    cal = made_calibration()
    return format_calibration(replace(cal, points=cal.points.select(slice(0, 4))))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10**6), junk=TREES)
def test_a_value_of_another_type_anywhere_is_refused_in_one_line(tmp_path_factory, seed, junk):
    chance = random.Random(seed)
    tree = yaml.load(of_four_points(), yaml.CSafeLoader)
    tree["neurocal"]["fit"]["n_points"] = 4
    node = tree
    while True:  # walk down at random and replace what is there
        key = chance.choice(list(node) if isinstance(node, dict) else range(len(node)))
        if not isinstance(node[key], (dict, list)) or not node[key] or chance.random() < 0.3:
            break
        node = node[key]
    node[key] = junk
    path = tmp_path_factory.getbasetemp() / "cal.yaml"
    refused_or_read(path, yaml.dump(tree, Dumper=yaml.CSafeDumper, default_flow_style=None))


@pytest.mark.parametrize(
    ("off", "message"), [(1e-5, ""), (1e-3, "neurocal.covariance.data must be symmetric")]
)
def test_a_covariance_may_be_off_its_transpose_by_rounding_only(
    off: float, message: str, tmp_path: Path
) -> None:
    cal = made_calibration(3)
    std = np.array([cal.std[name] for name in INTRINSIC_NAMES])
    covariance = np.diag(std**2) + np.triu(off * np.outer(std, std), 1)
    cal = replace(cal, covariance=covariance, covariance_names=INTRINSIC_NAMES)
    (tmp_path / "c.yaml").write_text(format_calibration(cal))
    with pytest.raises(FormatError, match=message) if message else nullcontext():
        assert (read_calibration(tmp_path / "c.yaml").covariance == covariance).all()
