"""`Correspondences`, the input of a calibration: known world points and their pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import UNDISTORTED, Array
from neurocal_cli.camera.given_values import checked_size, real_array, real_rows
from neurocal_cli.errors import InputError
from neurocal_cli.observations.distances import Distance
from neurocal_cli.observations.labels import factorise, first_repeat

_LARGEST = 1e100  # largest coordinate, so that squares do not overflow
_BY_ROW = (
    "world", "pixels", "view", "point", "covariance", "world_std", "across", "time", "image", "lines",
)  # fmt: skip


class Detected(Protocol):
    """Points of a target that were measured in one image, such as a `Detection`."""

    @property
    def ids(self) -> Sequence[str]:
        """Of N points; a point of the target has the same id in all images."""

    @property
    def world(self) -> Array:
        """(N, 3) array [world unit]."""

    @property
    def pixels(self) -> Array:
        """(N, 2) array [px]."""

    @property
    def covariance(self) -> Array:
        """(N, 3) array [px^2], suu, suv, svv."""

    @property
    def across(self) -> Array | None:
        """(N, 2) array or None; see `Correspondences`."""

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height [px]."""


@frozen_dataclass(eq=False)
class Correspondences:
    """World points and their pixels, grouped by view.

    Parameters
    ----------
    world : (N, 3) array
        X, Y, Z in the world's unit.
    pixels : (N, 2) array [px]
        u, v; the centre of the top-left pixel is (0, 0).
    view : (N,) labels, optional
        The image that each row belongs to; None: all rows are one view.
    image_size : (width, height), optional [px]
    image_center : (u0, v0), optional [px]
        The image centre as given with the data, for type 2.
    point : (N,) labels, optional
        An id that is the same for the same physical point in all images, and occurs once in each.
    covariance : (N, 3) array, optional [px^2]
        Columns suu, suv, svv of each pixel's covariance. Only ratios between points matter: the
        noise level itself is estimated from the residuals.
    across : (N, 2) array, optional
        Direction in the image in which each point was measured, of any length; (0, 0) for points measured in
        both directions. In the other direction the position was interpolated from other points of the view,
        such as that of a mid-point along its edge. None: all were measured in both.
    unit : str
        Of the world coordinates.
    source : str
        Name of the file or source, for messages.
    lines : (N,) int array, optional
        Line of each row in its file, for messages.
    sources : dict of str by view, optional
        The file of each view where several files were read, for messages.
    world_std : (N, 3) array, optional [world unit]
        Standard deviation of each world point's X, Y and Z, as a survey states it; 0 means exact. It must be
        the same for a world point in all views. All zero is None.
    time : (N,) array, optional [s]
        When the image of each row was taken; for cameras of one rig that do not take theirs at the same
        moment.
    image : (N,) labels, optional
        The image of each row, if the views are those of several boards in one image (`separate_boards`): then
        `view` is ``IMAGE:BOARD``, and `point` ``BOARD/ID``.
    distances : tuple of Distance
        Distances measured on the points' board; they determine its scale.
    board : str
        Text of the board file of the points' board; empty for a chessboard, which the ids tell.
    undistorted : str
        The shape, one of `UNDISTORTED`, that the pixels were projected on when they were undistorted. Empty:
        they are those of the image, as far as is known.

    Attributes
    ----------
    view_names : tuple of str
        In order of first appearance.
    view_index : (N,) int array
        Position of each row's view in `view_names`.

    Raises
    ------
    InputError
        Shapes do not match, there are no rows, a number is not real and finite (or beyond 1e100), a view has
        a point twice, or a covariance is not positive definite.
    """

    world: Array
    pixels: Array
    view: NDArray[Any] | Sequence[Any] | None = None
    image_size: tuple[int, int] | None = None
    image_center: tuple[float, float] | None = None
    point: NDArray[Any] | Sequence[Any] | None = None
    covariance: Array | None = None
    across: Array | None = None
    unit: str = "mm"
    source: str = "points"
    lines: NDArray[np.int64] | None = None
    sources: Mapping[str, str] | None = None
    world_std: Array | None = None
    time: Array | None = None
    image: NDArray[Any] | Sequence[Any] | None = None
    distances: tuple[Distance, ...] = ()
    board: str = ""
    undistorted: str = ""
    view_names: tuple[str, ...] = field(init=False)
    view_index: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        world = _matrix("world", self.world, 3)
        pixels = _matrix("pixels", self.pixels, 2)
        n = len(world)
        if len(pixels) != n:
            raise InputError(
                f"{self.source}: {n} world points but {len(pixels)} pixels; give one pixel a point"
            )
        if n == 0:
            raise InputError(f"{self.source}: there are no points; give at least one row of X,Y,Z,u,v")
        self._set(world=_frozen(world), pixels=_frozen(pixels))
        for name in ("view", "point", "lines", "image"):
            labels = getattr(self, name)
            if labels is not None:
                if not isinstance(labels, np.ndarray) or labels.flags.writeable:
                    labels = np.array(labels)  # a copy: it is made read-only
                if labels.shape != (n,):
                    raise InputError(f"{self.source}: {name} needs one entry for each of the {n} points")
                self._set(**{name: _frozen(labels)})
        self._check_finite()
        names, index = factorise(self.view, n)
        self._set(view_names=names, view_index=_frozen(index))
        if self.point is not None:
            self._check_ids(np.asarray(self.point))
        if self.covariance is not None:
            self._check_covariance(_matrix("covariance", self.covariance, 3))
        if self.distances and self.point is None:
            raise InputError(
                f"{self.source}: distances are between points with ids; add the column point, or leave the "
                "distances out"
            )
        if self.world_std is not None:
            std = _matrix("world_std", self.world_std, 3)
            good = np.asarray(((std >= 0) & (std <= _LARGEST)).all(axis=1))  # False for nan as well
            problem = "the world point's standard deviation sX,sY,sZ must be numbers of at least 0"
            self._set_rows("world_std", std, good, problem)
        if self.across is not None:
            across = _matrix("across", self.across, 2)
            good = np.asarray(np.abs(across).max(axis=1) <= _LARGEST)  # False for nan as well
            problem = "the direction nu,nv in which the point was measured must be two finite numbers"
            self._set_rows("across", across, good, problem)
        if self.time is not None:
            time = _matrix("time", np.reshape(self.time, (-1, 1)), 1)
            self._check_length("time", time)
            good = np.asarray(np.abs(time[:, 0]) <= _LARGEST)
            self._refuse_row(good, "the time must be a finite number of seconds")
            self._set(time=_frozen(time[:, 0]))
        if self.image_size is not None:
            self._set(image_size=checked_size(self.image_size))
        if self.image_center is not None:
            centre = real_array("image_center", self.image_center)
            if centre.shape != (2,) or not np.isfinite(centre).all():
                raise InputError(f"{self.source}: image_center must be two finite numbers")
            self._set(image_center=tuple(centre.tolist()))
        if self.undistorted and self.undistorted not in UNDISTORTED:
            raise InputError(f"{self.source}: undistorted must be one of {', '.join(UNDISTORTED)}, or empty")

    @classmethod
    def none(
        cls, image_size: tuple[int, int] | None = None, unit: str = "mm", undistorted: str = ""
    ) -> Correspondences:
        """Empty correspondences, for a camera without points of its own."""
        known: dict[str, Any] = {"image_size": image_size, "unit": unit, "undistorted": undistorted}
        empty = cls(np.zeros((1, 3)), np.zeros((1, 2)), **known)
        empty._set(world=_frozen(np.zeros((0, 3))), pixels=_frozen(np.zeros((0, 2))))
        empty._set(view_names=(), view_index=_frozen(np.zeros(0, dtype=np.int64)))
        return empty

    @classmethod
    def from_detections(
        cls,
        detections: Mapping[str, Detected],
        unit: str = "mm",
        distances: tuple[Distance, ...] = (),
        board: str = "",
    ) -> Correspondences:
        """Join the points that were measured in several images of one camera.

        Parameters
        ----------
        detections : dict of Detection by view name
            What `detect_points` returned for each image.
        unit : str
            Of the board.
        distances : tuple of Distance
            Those of the board, if any were measured: ``board.distances``.
        board : str
            Text of its file, if it is no chessboard.

        Raises
        ------
        InputError
            There is no image, or image sizes differ, so the images come from more than one camera.
        """
        if not detections:
            raise InputError("there are no images with points; give at least one")
        names, found = list(detections), list(detections.values())
        for name, one in zip(names, found, strict=True):
            if one.image_size != found[0].image_size:
                sizes = ["{} x {}".format(*each.image_size) for each in (one, found[0])]
                raise InputError(
                    f"the image {name} has {sizes[0]} px but {names[0]} has {sizes[1]} px; calibrate each "
                    "camera separately"
                )
        counts = [len(one.ids) for one in found]
        across = None
        if any(one.across is not None for one in found):
            # Vertices have no direction.
            parts = zip(found, counts, strict=True)
            across = np.concatenate(
                [np.zeros((n, 2)) if one.across is None else one.across for one, n in parts]
            )
        return cls(
            np.concatenate([one.world for one in found]),
            np.concatenate([one.pixels for one in found]),
            view=np.repeat(names, counts),
            image_size=found[0].image_size,
            point=np.array([name for one in found for name in one.ids]),
            covariance=np.concatenate([one.covariance for one in found]),
            across=across,
            unit=unit,
            source="detected points",
            distances=distances,
            board=board,
        )

    def __repr__(self) -> str:
        size = "unknown" if self.image_size is None else "{} x {} px".format(*self.image_size)
        known = ("point", "covariance", "across", "world_std", "time")
        columns = [name for name in known if getattr(self, name) is not None]
        with_them = f", with {', '.join(columns)}" if columns else ""
        return (
            f"Correspondences({len(self)} points in {self.n_views} views, image size {size}, "
            f"unit {self.unit!r}{with_them})"
        )

    def __len__(self) -> int:
        return len(self.world)

    @property
    def pixel_covariance(self) -> Array | None:
        """(N, 2, 2) covariance of each pixel [px^2], as far as it was given; see `covariance`."""
        return None if self.covariance is None else self.covariance[:, [0, 1, 1, 2]].reshape(-1, 2, 2)

    @property
    def n_points(self) -> int:
        """Number of rows."""
        return len(self.world)

    @property
    def n_views(self) -> int:
        """Number of views."""
        return len(self.view_names)

    @property
    def assumed_centre(self) -> tuple[float, float] | None:
        """The image centre [px] if it is taken for known: the given one, else the middle of the image."""
        if self.image_center is not None or self.image_size is None:
            return self.image_center
        width, height = self.image_size
        return (width - 1) / 2, (height - 1) / 2  # pixel centres run from 0 to the size less 1

    def place(self, row: int) -> str:
        """Origin of a row, as ``file:line`` or ``points, row 7``."""
        if self.lines is not None:
            source = self.source
            if self.sources is not None and self.view is not None:
                source = self.sources.get(str(self.view[row]), source)
            return f"{source}:{int(self.lines[row])}"
        return f"{self.source}, row {row + 1}"

    @property
    def view_times(self) -> Array | None:
        """(V,) mean time of each view [s], if it is known."""
        if self.time is None:
            return None
        counts = np.bincount(self.view_index, minlength=self.n_views)
        return np.asarray(np.bincount(self.view_index, self.time, self.n_views) / counts)

    def of_few_views(self, most: int) -> Correspondences:
        """The points of at most `most` views, evenly spaced among all."""
        if self.n_views <= most:
            return self
        return self.select(np.isin(self.view_index, np.linspace(0, self.n_views - 1, most).round()))

    def select(self, rows: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Correspondences:
        """The same data restricted to some rows (a mask, indices or a slice)."""

        def pick(values: Any) -> Any:
            return None if values is None else np.asarray(values)[rows]

        return replace(self, **{name: pick(getattr(self, name)) for name in _BY_ROW})

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _refuse_row(self, good: NDArray[np.bool_], problem: str) -> None:
        """Refuse the first row that is not good."""
        if not good.all():
            raise InputError(f"{self.place(int(np.argmin(good)))}: {problem}; correct or remove the row")

    def _check_finite(self) -> None:
        for name, values in (("X,Y,Z", self.world), ("u,v", self.pixels)):
            if values.min() >= -_LARGEST and values.max() <= _LARGEST:  # False for nan, 20 times faster
                continue
            good = np.abs(values).max(axis=1) <= _LARGEST  # False for nan as well
            found = ", ".join(f"{x:g}" for x in values[np.argmin(good)])
            self._refuse_row(good, f"{name} must be finite numbers of a sensible size, found {found}")
        if 0 < max(-self.world.min(), self.world.max()) < 1 / _LARGEST:
            raise InputError(f"{self.source}: X,Y,Z are too small to be squared; give them in another unit")

    def _check_ids(self, ids: NDArray[Any]) -> None:
        repeat = first_repeat(self.view_index, ids)
        if repeat is None:
            return
        row, earlier = repeat
        where = f"in row {earlier + 1}" if self.lines is None else f"on line {self.lines[earlier]}"
        name = "" if self.view is None else f" in the view {self.view_names[self.view_index[row]][:60]!r}"
        images = ", or name the image of each row as its view" if self.view is None else ""
        raise InputError(
            f"{self.place(row)}: the point {str(ids[row])[:60]!r} is already {where}{name}; remove one of "
            f"the rows{images}"
        )

    def _check_covariance(self, covariance: Array) -> None:
        self._check_length("covariance", covariance)
        suu, suv, svv = covariance.T
        with np.errstate(over="ignore", invalid="ignore"):
            good = (suu > 0) & (svv > 0) & (suu * svv > suv * suv) & (suu * svv < np.inf)
        self._refuse_row(
            np.asarray(good), "the pixel's covariance (sigma, or suu,suv,svv) must be positive definite"
        )
        self._set(covariance=_frozen(covariance))

    def _check_length(self, name: str, values: Array) -> None:
        if len(values) != len(self.world):
            raise InputError(f"{self.source}: {name} needs one row for each of the {len(self.world)} points")

    def _set_rows(self, name: str, values: Array, good: NDArray[np.bool_], problem: str) -> None:
        """Set values of all points, unless all are zero."""
        self._check_length(name, values)
        self._refuse_row(good, problem)
        self._set(**{name: _frozen(values) if values.any() else None})


def _matrix(name: str, values: ArrayLike, columns: int) -> Array:
    array = real_rows(name, values, columns)
    # Copy the array, unless nobody else can write to it: it may have a million rows.
    if not isinstance(values, np.ndarray) or values.flags.writeable or values.base is not None:
        array = array.copy()
    return array


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array.setflags(write=False)
    return array
