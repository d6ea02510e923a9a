"""The options that say how a camera is estimated: which problem, what is given, how to train."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import wraps
from typing import TYPE_CHECKING, Any

import click

from neurocal_cli.commands.options import INPUT, FiniteNumber
from neurocal_cli.commands.streams import note, warn
from neurocal_cli.errors import InputError, UsageError

if TYPE_CHECKING:
    from neurocal_cli.camera.camera import Camera
    from neurocal_cli.points import Correspondences
    from neurocal_cli.training.backprop import BackpropOptions

__all__ = ["Estimation", "estimation_options", "estimation_options_without_files", "given_camera"]

_BACKPROP_ONLY = {"epochs": "--epochs", "rate": "--rate", "rate_gamma": "--rate-gamma"}


@dataclass(frozen=True)
class Estimation:
    """What the user asked for; file names are not read yet."""

    type: str
    image_center: tuple[float, float] | None
    intrinsics: str | None
    extrinsics: str | None
    image_size: tuple[int, int] | None
    method: str
    trainer: str
    starts: int
    seed: int
    epochs: int | None
    rate: float | None
    rate_gamma: float | None
    distortion: str
    no_skew: bool
    outliers: str

    @property
    def stdin_candidates(self) -> tuple[str | None, ...]:
        """File names that may be ``-``."""
        return self.intrinsics, self.extrinsics

    def check(self) -> None:
        """Refuse options that contradict each other, before any file is read.

        Raises
        ------
        UsageError
        """
        for name, option, type_ in (
            (self.image_center, "--image-center", "2"),
            (self.intrinsics, "--intrinsics", "3"),
            (self.extrinsics, "--extrinsics", "4"),
        ):
            if name is not None and self.type != type_:
                raise UsageError(f"{option} belongs to --type {type_}; this is --type {self.type}")
        if self.type == "3" and self.intrinsics is None:
            raise UsageError("--type 3 needs the known intrinsic parameters; give --intrinsics CAMERA.yaml")
        if self.type == "4" and self.extrinsics is None:
            raise UsageError("--type 4 needs the known poses; give --extrinsics CAMERA.yaml")
        if self.type == "3" and self.no_skew:
            raise UsageError("--no-skew cannot change the given camera of --type 3; leave it out")
        if self.type == "3" and self.distortion not in ("auto", "none"):
            raise UsageError("--type 3 takes the lens of the given camera; leave out --distortion")
        for name, option in _BACKPROP_ONLY.items():
            if getattr(self, name) is not None and self.trainer != "backprop":
                raise UsageError(f"{option} belongs to --trainer backprop; this is --trainer {self.trainer}")

    def prepare(self, points: Correspondences) -> tuple[Correspondences, dict[str, Any]]:
        """Read the given files; return the points and the library's keyword arguments.

        Raises
        ------
        InputError
            A given camera that cannot be used with these points.
        UsageError
            Type 2 without any image centre.
        """
        if self.image_size is not None:
            if points.image_size not in (None, self.image_size):
                note([f"--image-size replaces the image_size of {points.source}"])
            points = replace(points, image_size=self.image_size)
        arguments: dict[str, Any] = {
            "type": int(self.type),
            "method": self.method,
            "trainer": self.trainer,
            "distortion": self.distortion,
            "skew": not self.no_skew,
            "outliers": self.outliers,
            "seed": self.seed,
            "starts": self.starts,
            "backprop": self._backprop(),
        }
        if self.type == "2":
            arguments["image_center"] = self._center(points)
        elif self.intrinsics is not None:
            points, arguments["intrinsics"] = given_camera(self.intrinsics, points)
        elif self.extrinsics is not None:
            from neurocal_cli.io.camera_files import read_extrinsics

            arguments["extrinsics"] = read_extrinsics(self.extrinsics)
        return points, arguments

    def _backprop(self) -> BackpropOptions | None:
        values = {"epochs": self.epochs, "rate_weights": self.rate, "rate_gamma": self.rate_gamma}
        given: dict[str, Any] = {name: value for name, value in values.items() if value is not None}
        if not given:
            return None
        from neurocal_cli.training.backprop import BackpropOptions

        return BackpropOptions(**given)

    def _center(self, points: Correspondences) -> tuple[float, float]:
        """Choose the image centre of type 2: as asked for, as in the points' header, or of the image."""
        if self.image_center is not None:
            return self.image_center
        if points.image_center is not None:
            return points.image_center
        if points.image_size is None:
            raise UsageError(
                f"--type 2 needs the image centre, and {points.source} names neither image_center nor "
                "image_size; give --image-center U V"
            )
        width, height = points.image_size
        center = (width - 1) / 2, (height - 1) / 2
        warn(
            [
                f"no image centre is given; the middle of the image, ({center[0]:g}, {center[1]:g}), is "
                "taken, and a real lens's centre may be tens of pixels away"
            ]
        )
        return center


def given_camera(path: str, points: Correspondences) -> tuple[Correspondences, Camera]:
    """Read a known camera; give the points its image size if they have none.

    Raises
    ------
    InputError
        A camera of another image size.
    """
    from neurocal_cli.io.camera_files import read_intrinsics

    camera = read_intrinsics(path)
    if camera.image_size is not None:
        if points.image_size is None:
            points = replace(points, image_size=camera.image_size)
        elif points.image_size != tuple(camera.image_size):
            raise InputError(
                f"{path}: made for images of {camera.image_size[0]} x {camera.image_size[1]} px, but "
                f"{points.source} has {points.image_size[0]} x {points.image_size[1]}; give the camera "
                "at the size of the points"
            )
    return points, camera


def estimation_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of `Estimation` to a command, which gets them as the keyword ``estimation``."""
    return _collecting(command, [*_OPTIONS[:_BEFORE_GIVEN], *_GIVEN, *_OPTIONS[_BEFORE_GIVEN:]])


def estimation_options_without_files(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add all of them but the files of known cameras and poses."""
    return _collecting(command, _OPTIONS)


def _collecting(command: Callable[..., Any], options: list[Any]) -> Callable[..., Any]:
    names = [field.name for field in fields(Estimation)]

    @wraps(command)
    def collected(*args: Any, **kwargs: Any) -> Any:
        estimation = Estimation(**{name: kwargs.pop(name, None) for name in names})
        return command(*args, estimation=estimation, **kwargs)

    for option in reversed(options):
        collected = option(collected)
    return collected


_GIVEN = [
    click.option(
        "--intrinsics",
        type=INPUT,
        metavar="CAMERA.yaml",
        show_default="none",
        help="Type 3: the known camera, a neurocal, ROS or OpenCV file.",
    ),
    click.option(
        "--extrinsics",
        type=INPUT,
        metavar="CAMERA.yaml",
        show_default="none",
        help="Type 4: a neurocal file with the known poses of the views.",
    ),
]

_BEFORE_GIVEN = 2  # options that come first in the help
_OPTIONS = [
    click.option(
        "--type",
        "type",
        type=click.Choice(["1", "2", "3", "4"]),
        default="1",
        help="What is unknown: 1 all, 2 all but the image centre, 3 the pose, 4 the intrinsic parameters.",
    ),
    click.option(
        "--image-center",
        type=FiniteNumber(),
        nargs=2,
        metavar="U V",
        show_default="image_center of POINTS, else the middle of the image",
        help="Type 2: the known image centre in pixels.",
    ),
    click.option(
        "--image-size",
        type=click.IntRange(min=1),
        nargs=2,
        metavar="W H",
        show_default="image_size of POINTS",
        help="Width and height of the images in pixels.",
    ),
    click.option(
        "--method",
        type=click.Choice(["neuro"]),
        default="neuro",
        help="How to estimate: neuro trains the network.",
    ),
    click.option(
        "--trainer",
        type=click.Choice(["lm", "backprop"]),
        default="lm",
        help="How the network learns: Levenberg-Marquardt, or the paper's back-propagation.",
    ),
    click.option(
        "--starts",
        type=click.IntRange(min=2),
        metavar="N",
        default=20,
        help="Try at most this many random starts until two of them agree.",
    ),
    click.option(
        "--seed",
        type=click.IntRange(min=0),
        metavar="S",
        default=0,
        help="Seed of the random weights; the same seed gives the same file.",
    ),
    click.option(
        "--epochs",
        type=click.IntRange(min=1),
        metavar="N",
        show_default="50000",
        help="Backprop: pass over the points at most this many times.",
    ),
    click.option(
        "--rate",
        type=FiniteNumber(positive=True),
        metavar="RATE",
        show_default="0.05",
        help="Backprop: learning rate of the weights.",
    ),
    click.option(
        "--rate-gamma",
        type=FiniteNumber(positive=True),
        metavar="RATE",
        show_default="0.4",
        help="Backprop: learning rate of the factors gamma.",
    ),
    click.option(
        "--distortion",
        type=click.Choice(
            ["auto", "none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "rational", "fisheye", "plumb-line"]
        ),
        default="auto",
        help="Lens model, estimated with everything else, coefficients as in OpenCV; none is the pinhole, "
        "auto the simplest model that predicts data left out as well as any; plumb-line takes k1, k2, p1 and "
        "p2 from the images of straight lines alone.",
    ),
    click.option(
        "--no-skew",
        is_flag=True,
        help="Hold the angle between the image axes at 90 degrees.",
    ),
    click.option(
        "--outliers",
        type=click.Choice(["reject", "keep"]),
        default="reject",
        help="What to do with points, and whole views, that contradict the others: reject names them and "
        "leaves them out, keep uses all of them.",
    ),
]
