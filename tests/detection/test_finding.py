"""Finding chessboards: complete, rightly indexed, and nothing where there is none."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.occluders import Rectangle
from support.picture_bound import scene_bound
from support.pictures import PlaneTruth, ground_truth
from support.real_data import RealFiles
from support.rendered import condition, picture, rendered
from support.slow_cases import slow_but

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection import Grid
from neurocal_cli.detection.finding import saddles as find_levels
from neurocal_cli.detection.finding.grids import find_grids
from neurocal_cli.detection.finding.lattice import Lattice
from neurocal_cli.detection.finding.links import find_links, find_seeds, linked_group
from neurocal_cli.detection.finding.overlaps import split_at_folds
from neurocal_cli.detection.finding.saddles import grey_levels, pyramid, refine_saddles

cv2 = pytest.importorskip("cv2")

FIRST = 500  # seeds that nothing was developed on

WHOLE = (
    "base",
    "noise 5",
    "noise 12",
    "psf 0.5",
    "psf 3",
    "poisson",
    "tilt 0",
    "tilt 65",
    "k1 -0.3",
    "k1 -0.4 wide",
    "skew",
    "gamma 2.2",
    "saturated",
    "16 bit",
    "squares 10",
    "squares 6",
    "illumination",
    "vignetting",
    "low contrast",
    "narrow margin",
    "clutter",
    "mix",
)
FOLDED = ("two planes", "two planes distorted", "two planes across", "three planes", "three planes across")


def turned(shape: tuple[int, int]) -> Iterable[tuple[Array, Array]]:
    """Row and column in a grid of each vertex of a board, for the four ways of turning it."""
    rows, cols = np.indices(shape)
    yield rows, cols
    yield cols, shape[0] - 1 - rows
    yield shape[0] - 1 - rows, shape[1] - 1 - cols
    yield shape[1] - 1 - cols, rows


def matched(grid: Grid, truth: PlaneTruth, within: float = 1.0) -> tuple[np.ndarray, int]:
    """(rows, cols) which true vertices a grid has under the right index, and how many others it has."""
    vertices = truth.vertices
    mirrored = _mirrored(vertices)
    if mirrored:
        vertices = vertices[:, ::-1]
    best, wrong = np.zeros(vertices.shape[:2], dtype=bool), int(grid.seen.sum())
    for rows, cols in turned(vertices.shape[:2]):
        hit = _hits(grid, vertices, rows, cols, within)
        if hit.sum() > best.sum():
            best, wrong = hit, int(grid.seen.sum() - hit.sum())
    return (best[:, ::-1] if mirrored else best), wrong


def _mirrored(vertices: Array) -> bool:
    c = np.nanmean(vertices[:, 1:] - vertices[:, :-1], axis=(0, 1))
    r = np.nanmean(vertices[1:] - vertices[:-1], axis=(0, 1))
    return bool(c[0] * r[1] < c[1] * r[0])


def _hits(grid: Grid, vertices: Array, rows: Array, cols: Array, within: float) -> np.ndarray:
    """Which vertices are at their places of a grid, shifted as most of them are."""
    found = np.argwhere(grid.seen)
    away = np.hypot(*np.moveaxis(grid.pixels[grid.seen][:, None, None] - vertices, -1, 0))
    away = np.where(np.isfinite(away), away, np.inf)
    nearest = away.reshape(len(found), -1).argmin(axis=1)
    close = away.reshape(len(found), -1)[np.arange(len(found)), nearest] < within
    shift = found - np.stack([rows.ravel()[nearest], cols.ravel()[nearest]], axis=-1)
    hit = np.zeros(vertices.shape[:2], dtype=bool)
    if close.any():
        kinds, count = np.unique(shift[close], axis=0, return_counts=True)
        right = close & (shift == kinds[count.argmax()]).all(axis=1)
        hit.ravel()[nearest[right]] = True
    return hit


def best_match(grids: list[Grid], truth: PlaneTruth, within: float = 1.0) -> tuple[np.ndarray, int]:
    none = np.zeros(truth.vertices.shape[:2], dtype=bool), 0
    return max((matched(g, truth, within) for g in grids), key=lambda m: m[0].sum(), default=none)


def missed(name: str, seeds: Iterable[int], within: float = 1.0) -> list[tuple[int, int, int]]:
    """Seeds whose pictures are not found exactly, with vertices missed and wrong ones."""
    result = []
    for seed in seeds:
        shot = picture(name, seed)
        grids = find_grids(shot.image)
        for truth in shot.truth.planes:
            hit, wrong = best_match(grids, truth, within)
            if wrong or not hit.all():
                result.append((seed, int((~hit).sum()), wrong))
        if len(grids) != len(shot.truth.planes):
            result.append((seed, 0, len(grids)))
    return result


def open_around(truth: PlaneTruth, size: tuple[int, int]) -> np.ndarray:
    """(rows, cols) which vertices have half a square around them in plain sight."""
    seen = truth.vertices_visible.copy()
    hidden = np.zeros(seen.size, dtype=bool)
    hidden[truth.ends[~truth.midpoints_visible].ravel()] = True
    seen &= ~hidden.reshape(seen.shape)
    c, r = np.gradient(truth.vertices, axis=1), np.gradient(truth.vertices, axis=0)
    for i in (-0.5, 0.5):
        for j in (-0.5, 0.5):
            corner = truth.vertices + i * c + j * r
            with np.errstate(invalid="ignore"):
                seen &= ((corner >= 0) & (corner <= np.array(size) - 1)).all(axis=-1)
    return seen


@pytest.mark.parametrize("name", slow_but(("k1 -0.4 wide", "squares 6", "mix"), WHOLE))
def test_a_whole_board_is_found_completely(name: str) -> None:
    assert missed(name, [FIRST]) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", WHOLE)
def test_whole_boards_are_found_completely(name: str) -> None:
    assert missed(name, range(FIRST, FIRST + 8)) == []


@pytest.mark.slow
def test_boards_seen_almost_from_the_side_are_found_unless_squares_are_three_pixels_wide() -> None:
    assert len(missed("tilt 75", range(FIRST, FIRST + 16))) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["2 Mpx", "5 Mpx", "5 Mpx clutter"])
def test_boards_in_large_pictures_are_found(name: str) -> None:
    assert missed(name, range(FIRST, FIRST + 2)) == []


@pytest.mark.parametrize("name", slow_but(("two planes across",), FOLDED))
def test_planes_at_a_fold_are_separate_grids(name: str) -> None:
    assert missed(name, range(FIRST, FIRST + 2)) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", FOLDED)
def test_planes_at_a_fold_are_separate_grids_in_many_poses(name: str) -> None:
    assert len(missed(name, range(FIRST, FIRST + 25))) <= 1


@pytest.mark.parametrize("name", slow_but(("base",), ("base", "k1 -0.3", "psf 3")))
def test_vertices_are_good_to_a_few_tenths_of_a_pixel(name: str) -> None:
    assert missed(name, range(FIRST, FIRST + 2), within=0.3) == []


def test_vertices_off_to_alternate_sides_are_no_fold() -> None:
    """Seen on an overexposed board; few rows have none afar to compare with."""
    fine = 8
    row, col = np.mgrid[-1:6, -1:5].astype(float)
    off = np.where((row + col) % 2 == 0, 0.3, -0.3)
    x, y = col - 1.5, row - 2
    place = np.stack([150 + 19.5 * x - 19.5 * y, 75 + 9.0 * x + 7.4 * y], axis=-1)
    place[..., 1] += off
    large = np.full((150 * fine, 300 * fine), 230, np.uint8)
    for r, c in np.argwhere((row + col)[:-1, :-1] % 2 == 0):
        square = place[[r, r, r + 1, r + 1], [c, c + 1, c + 1, c]]
        corners = np.rint(16 * ((square + 0.5) * fine - 0.5)).astype(np.int32)
        cv2.fillConvexPoly(large, corners, (20.0,), shift=4)
    image = cv2.GaussianBlur(cv2.resize(large, (300, 150), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    grids = find_grids(image)
    assert [sorted(x.pixels.shape[:2]) for x in grids] == [[4, 5]]
    assert grids[0].seen.all()


def test_grids_are_oriented_as_promised() -> None:
    shot = picture("base", FIRST + 3)
    (grid,) = find_grids(shot.image)
    p = grid.pixels
    c, r = p[:-1, 1:] - p[:-1, :-1], p[1:, :-1] - p[:-1, :-1]
    assert (c[..., 0] * r[..., 1] - c[..., 1] * r[..., 0] > 0).all()
    u, v = np.rint(0.25 * (p[1:, 1:] + p[1:, :-1] + p[:-1, 1:] + p[:-1, :-1])).astype(int).transpose(2, 0, 1)
    rows, cols = np.indices(u.shape)
    dark = shot.image[v, u] < 128
    assert (dark == ((rows + cols + grid.dark) % 2 == 0)).all()


def before_its_own_small_picture(reduced: int) -> tuple[np.ndarray, tuple[int, int]]:
    """A board with a picture of itself, so many times smaller, in a corner of the image; and its shape."""
    image = np.array(picture("base", FIRST).image)
    (grid,) = find_grids(image)
    low = np.floor(np.nanmin(grid.pixels, axis=(0, 1)) - 45).astype(int)
    size = (np.ceil(np.nanmax(grid.pixels, axis=(0, 1)) + 45).astype(int) - low) // reduced
    part = image[low[1] : low[1] + size[1] * reduced, low[0] : low[0] + size[0] * reduced]
    small = part.reshape(size[1], reduced, size[0], reduced).mean(axis=(1, 3))
    image[: size[1], : size[0]] = np.rint(small)
    return image, grid.shape


def test_far_behind_the_board_that_is_wanted_nothing_is_looked_for() -> None:
    image, shape = before_its_own_small_picture(4)
    near, far = find_grids(image)
    (alone,) = find_grids(image, [shape])
    assert near.shape == far.shape == shape
    assert (alone.pixels == near.pixels).all()
    assert len(find_grids(image, [(shape[0] + 1, shape[1])])) == 2
    assert len(find_grids(image, [shape[::-1]])) == 1


def test_what_is_nearly_as_near_is_looked_for_all_the_same() -> None:
    image, shape = before_its_own_small_picture(2)
    assert len(find_grids(image, [shape])) == 2


@pytest.mark.parametrize("name", slow_but(("occluded",), ("occluded", "board cut", "two boards")))
@pytest.mark.parametrize("count", [2, pytest.param(16, marks=pytest.mark.slow)])
def test_visible_vertices_of_partly_hidden_boards_are_found(name: str, count: int) -> None:
    found = total = wrong = 0
    for seed in range(FIRST, FIRST + count):
        shot = picture(name, seed)
        grids = find_grids(shot.image)
        for truth in shot.truth.planes:
            # One just under the edge of what hides it may be found beside its place.
            hit, others = best_match(grids, truth, within=2.0)
            visible = open_around(truth, shot.image.shape[::-1])
            found, total, wrong = found + (hit & visible).sum(), total + visible.sum(), wrong + others
    assert wrong == 0
    assert found >= 0.99 * total


def test_a_board_that_is_linked_with_the_one_behind_it_is_found_whole() -> None:
    """Both are one lattice at first, which falls apart once it has grown."""
    shot = picture("two boards", FIRST + 10)
    sizes = [sorted(grid.shape) for grid in find_grids(shot.image) if grid.seen.all()]
    assert sizes == [[5, 6]]


@pytest.mark.parametrize("count", [3, pytest.param(30, marks=pytest.mark.slow)])
def test_there_is_no_grid_in_clutter(count: int) -> None:
    found = [bool(find_grids(picture("clutter only", FIRST + k).image)) for k in range(count)]
    assert sum(found) <= 0.05 * count


@pytest.mark.slow
def test_hard_mixtures_are_found_as_far_as_physics_allows() -> None:
    found: dict[bool, list[bool]] = {False: [], True: []}
    for name in ("stress 1", "stress 2"):
        for seed in range(FIRST, FIRST + 30):
            bound = float(np.median(scene_bound(condition(name, seed))[0].vertex))
            if bound < 0.1:
                found[bound > 0.03].append(not [m for m in missed(name, [seed]) if m[1] or m[2] > 2])
    assert np.mean(found[False]) >= 0.97
    assert np.mean(found[True]) >= 0.8


def test_sixteen_bits_and_real_numbers_give_what_eight_bits_give() -> None:
    image = picture("clutter", FIRST).image
    (grid,) = find_grids(image)
    for other in (image.astype(np.uint16) * 257, image / 255.0, image.astype(np.float32)):
        (same,) = find_grids(other)
        assert same.dark == grid.dark
        assert np.abs(same.pixels - grid.pixels).max() < 0.01


@pytest.mark.parametrize("size", [(8, 8), (1, 500), (3, 3), (0, 0), (480, 640), (2000, 3000)])
@pytest.mark.parametrize("level", slow_but((255,), (0, 255)))
def test_blank_images_of_any_size_have_no_grid(size: tuple[int, int], level: int) -> None:
    assert find_grids(np.full(size, level, dtype=np.uint8)) == []


def test_noise_and_numbers_that_are_none_have_no_grid() -> None:
    rng = np.random.default_rng(1)
    assert find_grids(rng.integers(0, 256, (480, 640), dtype=np.uint8)) == []
    assert find_grids(np.full((100, 100), np.nan)) == []
    assert find_grids(np.full((100, 100), np.inf)) == []


def test_finding_is_deterministic() -> None:
    image = picture("three planes", FIRST).image
    first, second = find_grids(image), find_grids(image.copy())
    assert all(np.array_equal(a.pixels, b.pixels, equal_nan=True) for a, b in zip(first, second, strict=True))


def shapes(path: Path) -> list[tuple[int, ...]]:
    """Shapes of the whole grids in a picture, the smaller number first."""
    grids = find_grids(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    return [tuple(sorted(grid.shape)) for grid in grids if grid.seen.all()]


@pytest.mark.parametrize("step", [4, pytest.param(1, marks=pytest.mark.slow)])
def test_all_boards_of_a_stereo_rig_are_found(real_files: RealFiles, step: int) -> None:
    paths = list(real_files("opencv_stereo/*.jpg"))[::step]
    assert [path.name for path in paths if shapes(path)[:1] != [(6, 9)]] == []


def test_all_boards_on_a_table_are_found(real_files: RealFiles) -> None:
    assert [path.name for path in real_files("sony_chess/*.jpg") if shapes(path) != [(4, 6)]] == []


def test_a_board_of_900_vertices_is_found(real_files: RealFiles) -> None:
    assert shapes(real_files("line_pattern/chessboard.jpg")[0]) == [(25, 36)]


def test_three_walls_are_found_at_once(real_files: RealFiles) -> None:
    for path in real_files("ortho3/*.jpg"):
        assert sorted(shapes(path)) == [(6, 7), (6, 8), (6, 8)]


def test_separate_squares_are_no_board(real_files: RealFiles) -> None:
    assert [path.name for path in real_files("zhang_planar/*.png") if shapes(path)] == []


@pytest.mark.parametrize("seed", slow_but((FIRST,), (FIRST, FIRST + 1)))
def test_a_board_in_two_halves_is_one_grid(seed: int) -> None:
    scene = condition("base", seed)
    truth = ground_truth(scene).planes[0].vertices
    middle = 0.5 * (truth[2, 4] + truth[3, 4])
    along = truth[3, 4] - truth[2, 4]
    angle = float(np.arctan2(along[1], along[0]))
    bar = Rectangle((float(middle[0]), float(middle[1])), (500.0, 30.0), angle, 0.4)
    shot = rendered(replace(scene, occluders=(bar,)), np.random.default_rng(1))
    grids = find_grids(shot.image)
    hit, wrong = best_match(grids, shot.truth.planes[0])
    visible = open_around(shot.truth.planes[0], shot.image.shape[::-1])
    assert wrong == 0
    assert (hit | ~visible).all()
    assert len(grids) == 1


def test_noise_of_large_pictures_is_found_in_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    image = picture("noise 5", FIRST).image.astype(np.float32)
    whole = find_levels.Level(image, 1).noise
    monkeypatch.setattr(find_levels, "_LARGE", 0)
    assert find_levels.Level(image, 1).noise == pytest.approx(whole, rel=0.1)


def test_a_single_line_of_vertices_has_no_fold() -> None:
    pixels = np.stack([np.full(6, 100.0), 100.0 + 30 * np.arange(6) + 8 * (np.arange(6) > 2)], axis=-1)[
        :, None
    ]
    line = Lattice(pixels, np.full((6, 1), 90.0), 0)
    assert [part.seen.shape for part in split_at_folds(line)] == [(6, 1)]


@pytest.mark.parametrize("name", slow_but(("noise 12",), ("base", "noise 12", "k1 -0.3")))
def test_links_put_a_plain_board_together(name: str) -> None:
    shot = picture(name, FIRST)
    level = pyramid(grey_levels(shot.image))[-1]
    links = find_links(level)
    assert links is not None
    _, members = linked_group(links, int(find_seeds(links)[0, 1, 1]))
    found = level.scale * links.saddles.points[members]
    true = shot.truth.planes[0].vertices.reshape(-1, 2)
    away = np.hypot(*(found[:, None] - true).transpose(2, 0, 1))
    assert away.min(axis=1).max() < 2.0
    assert (away.min(axis=0) < 2.0).mean() > 0.9


def test_saddles_settle_where_they_are() -> None:
    shot = picture("base", FIRST)
    image, vertices = pyramid(grey_levels(shot.image))[0].image, shot.truth.planes[0].vertices.reshape(-1, 2)
    start = vertices + np.random.default_rng(1).uniform(-1, 1, vertices.shape)
    settled = refine_saddles(image, start, 1.5)
    assert np.abs(settled - vertices).max() < 0.1
    # Half-way between pixels, each of the two may lead to the other.
    again = np.abs(refine_saddles(image, settled, 1.5, rounds=1) - settled).max(axis=1)
    assert again.max() < 0.2
    assert (again < 1e-9).mean() > 0.8
    assert np.isnan(refine_saddles(image, np.array([[-5.0, 20.0], [np.nan, 3.0]]), 1.5)).all()


@pytest.mark.parametrize("light", slow_but((0.03,), (0.5, 0.35, 0.2, 0.03)))
@pytest.mark.parametrize("seed", slow_but((0,), range(4)))
def test_a_board_half_in_a_deep_shadow_is_found(light: float, seed: int) -> None:
    shot = picture("base", FIRST + seed)
    (truth,) = shot.truth.planes
    middle = truth.vertices.mean(axis=(0, 1))
    v, u = np.indices(shot.image.shape)
    away = (u - middle[0]) * np.cos(seed) + (v - middle[1]) * np.sin(seed)
    lit = light + (1 - light) * 0.5 * (1 + np.tanh(away / 1.5))
    image = np.rint(8 + (shot.image.astype(float) - 8) * lit).astype(np.uint8)
    hit, wrong = best_match(find_grids(image), truth)
    assert wrong == 0
    assert hit.mean() > 0.8


@pytest.mark.parametrize(("side", "narrow"), [(5, 1.0), (8, 0.5)])
def test_squares_too_small_for_the_searched_levels_are_found(side: int, narrow: float) -> None:
    board = np.kron(np.indices((7, 10)).sum(axis=0) % 2, np.ones((4 * side, 4 * side)))
    smooth = cv2.GaussianBlur(np.pad(board, 4 * side, constant_values=1).astype(np.float32), (0, 0), 3.0)
    c, s = 0.25 * np.cos(0.3), 0.25 * np.sin(0.3)
    M = np.array([[c, -s * narrow, 1000.3], [s, c * narrow, 700.7]])
    light = cv2.warpAffine(smooth, M, (1700, 1300), borderMode=cv2.BORDER_CONSTANT, borderValue=(0.6,))
    noise = np.random.default_rng(1).normal(0, 2, light.shape)
    (grid,) = find_grids(np.clip(30 + 200 * light + noise, 0, 255).astype(np.uint8), [(9, 6)])
    assert np.isfinite(grid.pixels[..., 0]).sum() >= 53
    corner = M @ [8.0 * side - 0.5, 8.0 * side - 0.5, 1]
    assert np.nanmin(np.hypot(*(grid.pixels - corner).reshape(-1, 2).T)) < 0.5
