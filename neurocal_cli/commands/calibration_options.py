"""The options of a calibration: problem type, given parameters, training, distortion, outliers, target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.options import F
from neurocal_cli.commands.streams import note, warn
from neurocal_cli.errors import UsageError

if TYPE_CHECKING:
    from neurocal_cli.calibration.calibrate import CameraOptions, Outliers
    from neurocal_cli.calibration.calibration import Calibration
    from neurocal_cli.camera.camera import Camera
    from neurocal_cli.observations.points import Correspondences

# Options of back-propagation only, and their names in `BackpropOptions`.
_BACKPROP = {"epochs": "epochs", "rate": "rate_weights", "rate_gamma": "rate_gamma"}

# Options that are arguments of `calibrate` with the same name and value.
_SAME = ("method", "trainer", "distortion", "outliers", "target", "seed", "starts")


@frozen_dataclass
class Estimation:
    """The values of the options; files are not read yet."""

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
    skew: str
    square_pixels: bool
    fix: options.Named
    outliers: Outliers
    target: str

    def check(self) -> None:
        """Refuse options that contradict each other, before any file is read, with a UsageError."""
        if self.type == "3" and self.intrinsics is None:
            raise UsageError("--type 3 needs the known intrinsic parameters; give --intrinsics CAMERA.yaml")
        if self.type == "4" and self.extrinsics is None:
            raise UsageError("--type 4 needs the known poses; give --extrinsics CAMERA.yaml")
        angles = {
            "--no-skew": self.no_skew,
            "--square-pixels": self.square_pixels,
            "--fix theta=90": "theta" in self._fixed(),
        }
        of_camera = {"--skew": self.skew != "free", **angles, "--fix": bool(self.fix)}
        for option in (option for option, is_given in of_camera.items() if is_given):
            if self.type == "3":
                raise UsageError(f"--type 3 does not change the given camera; leave out {option}")
            if option in angles and (self.skew == "auto" or (self.skew == "free" and options.typed("skew"))):
                raise UsageError(f"{option} is --skew fixed, but --skew is {self.skew}; give one of them")
        if self.square_pixels and self.distortion == "plumb-line":
            raise UsageError(
                "--square-pixels does not go with --distortion plumb-line; name k1k2p1p2 instead"
            )
        for option, is_given, other, wanted in (
            ("--image-center", self.image_center is not None, "type", "2"),
            ("--intrinsics", self.intrinsics is not None, "type", "3"),
            ("--extrinsics", self.extrinsics is not None, "type", "4"),
            ("--epochs", self.epochs is not None, "trainer", "backprop"),
            ("--rate", self.rate is not None, "trainer", "backprop"),
            ("--rate-gamma", self.rate_gamma is not None, "trainer", "backprop"),
            (f"--trainer {self.trainer}", self.trainer != "lm", "method", "neuro"),
            ("--skew auto", self.skew == "auto", "method", "neuro"),
            ("--square-pixels", self.square_pixels, "method", "neuro"),
            ("--fix", bool(self.fix), "method", "neuro"),
        ):
            if is_given and (value := getattr(self, other)) != wanted:
                need = f"--{other} {wanted}"
                raise UsageError(
                    f"{option} needs {need}, but the {other} is {value}; give {need}, or leave it out"
                )
        if self.method != "neuro":
            unused = ("starts", "seed", *(["outliers"] if self.outliers == "reject" else []))
            options.note_unused(f"with --method {self.method}", *unused)

    def _fixed(self) -> dict[str, float]:
        """The values of ``--fix`` by name; theta in degrees."""
        fixed: dict[str, float] = {}
        for name, text in self.fix:
            try:
                value = float(text)
            except ValueError:
                raise UsageError(f"--fix {name}={text}: the value is no number; correct it") from None
            if fixed.setdefault(name, value) != value:
                raise UsageError(f"--fix gives {name} twice, and differs; keep one")
        if fixed.get("theta", 90.0) != 90.0:
            raise UsageError("--fix theta: the angle between the image axes is fixed at 90 degrees only")
        return fixed

    def of_known(self, intrinsics: str) -> Estimation:
        """The same for a camera that is known, of which only the poses are estimated."""
        return replace(
            self, type="3", intrinsics=intrinsics, image_center=None, no_skew=False, skew="free", fix=(),
            square_pixels=False, distortion="none",
        )  # fmt: skip

    def prepare(self, points: Correspondences) -> tuple[Correspondences, CameraOptions]:
        """Read the given files; return the points and the library's keyword arguments."""
        if self.image_size is not None:
            if points.image_size not in (None, self.image_size):
                note(f"--image-size is used instead of the image_size in {points.source}")
            points = replace(points, image_size=self.image_size)
        arguments: dict[str, Any] = {name: getattr(self, name) for name in _SAME}
        fix = self._fixed()
        right_angle = self.no_skew or self.square_pixels or fix.pop("theta", None) is not None
        if self.square_pixels:
            arguments["square_pixels"] = True
            fix.pop("theta", None)
        arguments |= {"type": int(self.type), "skew": "fixed" if right_angle else self.skew}
        if fix:
            arguments["fix"] = fix
        values = {to: getattr(self, name) for name, to in _BACKPROP.items()}
        if given := {to: value for to, value in values.items() if value is not None}:
            from neurocal_cli.network.backprop import BackpropOptions

            arguments["backprop"] = BackpropOptions(**given)
        if self.type == "2":
            arguments["image_center"] = self._center(points)
        elif self.intrinsics is not None:
            from neurocal_cli.calibration.calibration import Calibration

            points, arguments["intrinsics"] = self._known(points)
            camera = arguments["intrinsics"]
            if self.distortion != "none":
                arguments["distortion"] = "auto"
            if not (isinstance(camera, Calibration) and camera.known_covariance[0]):
                _note_exact(f"{self.intrinsics} does not say how accurate its camera is, so it")
        elif self.extrinsics is not None:
            from neurocal_cli.files.calibration_yaml import read_extrinsics

            arguments["extrinsics"] = read_extrinsics(self.extrinsics, points.unit)
            _note_exact("each given pose")
        return points, cast("CameraOptions", arguments)

    def _known(self, points: Correspondences) -> tuple[Correspondences, Camera | Calibration]:
        """The known camera; --distortion names its model if the file does not."""
        from neurocal_cli.camera.camera import camera_of
        from neurocal_cli.camera.distortion import MODELS

        assert self.intrinsics is not None
        given = self.distortion if self.distortion in MODELS and self.distortion != "none" else None
        points, camera = preparation.given_camera(self.intrinsics, points, given)
        if self.distortion not in ("auto", "none", camera_of(camera).distortion.model):
            raise UsageError("--type 3 uses the distortion model of the given camera; leave out --distortion")
        return points, camera

    def _center(self, points: Correspondences) -> tuple[float, float]:
        """The image centre of type 2: from the option, the points' header, or the middle of the image."""
        center = self.image_center or points.assumed_centre
        if center is None:
            raise UsageError(
                f"--type 2 needs the image centre, but {points.source} has neither image_center nor "
                "image_size; give --image-center U V"
            )
        if self.image_center is None and points.image_center is None:
            warn(
                "no image centre is given, so the middle of the image, "
                f"({center[0]:g}, {center[1]:g}), is used; the true centre may be tens of pixels away"
            )
        return center


def _note_exact(what: str) -> None:
    note(f"{what} is taken as exact: the standard deviations do not include its errors")


def estimation_options(files: bool = True) -> Callable[[F], F]:
    """Add the options of `Estimation`, a command's keyword ``estimation``; known cameras only if `files`."""
    added = [option for option in _OPTIONS if files or option not in _FILES]
    return options.collected(Estimation, added, "estimation")


_FILES = [
    options.path(
        "--intrinsics", "CAMERA.yaml", "With --type 3: the known camera, a neurocal, ROS or OpenCV file."
    ),
    options.path(
        "--extrinsics", "CAMERA.yaml", "With --type 4: a neurocal file with the known pose of each view."
    ),
]

_LENSES = f"auto {options.MODELS} rich plumb-line"
_OPTIONS = [
    options.choice(
        "--type",
        "1 2 3 4",
        "What is known: 1 nothing, 2 the image centre, 3 the intrinsic parameters, 4 the poses.",
        default="1",
    ),
    options.number(
        "--image-center",
        "U V",
        "With --type 2: the known image centre in pixels.",
        without="image_center in POINTS, else the middle of the image",
    ),
    *_FILES,
    options.count(
        "--image-size", "W H", "Width and height of the images in pixels.", without="image_size in POINTS"
    ),
    options.choice(
        "--method",
        "neuro linear nonlinear tsai",
        "Estimation method: neuro trains the network and refines its result by bundle adjustment. "
        "linear is a closed form, nonlinear is Levenberg-Marquardt from it, tsai is two-stage radial "
        "alignment; these three are for comparison, and use all points.",
        default="neuro",
    ),
    options.choice(
        "--trainer",
        "lm backprop",
        "Training of the network: lm is Levenberg-Marquardt, backprop is the paper's back-propagation.",
        default="lm",
    ),
    options.count(
        "--starts",
        "N",
        "With --method neuro: maximum number of random starts. Training ends when two of them agree.",
        default=20,
        least=2,
    ),
    options.seed,
    options.count(
        "--epochs", "N", "With --trainer backprop: maximum number of passes over the points.", without="50000"
    ),
    options.number(
        "--rate",
        "RATE",
        "With --trainer backprop: learning rate of the weights.",
        without="0.05",
        positive=True,
    ),
    options.number(
        "--rate-gamma",
        "RATE",
        "With --trainer backprop: learning rate of the scale factors gamma.",
        without="0.4",
        positive=True,
    ),
    options.choice(
        "--distortion",
        _LENSES,
        f"Distortion model, with coefficients as in OpenCV: {options.one_of(_LENSES)}. "
        "none is a pinhole camera. thin_prism and tilted are OpenCV's models of 12 and 14 "
        "coefficients. fisheye, omnidir, double_sphere and eucm are for wide lenses, also beyond 180 "
        "degrees. rich is a fisheye with a smooth displacement of the image, for lenses that no other model "
        "describes. "
        "auto chooses from none to rational and fisheye, by error and number of "
        "coefficients, takes omnidir for wide lenses that are decentred, and rich where it predicts views "
        "left out decidedly better than any other. "
        "plumb-line estimates k1, k2, p1 and p2 from the straight lines of the target alone.",
        metavar="MODEL",
        default="auto",
    ),
    options.no_skew,
    options.skew,
    options.fix,
    options.square_pixels,
    options.choice(
        "--outliers",
        "reject keep",
        "Treatment of outliers, which are points or whole views that contradict the others: reject "
        "leaves them out and lists them, keep uses all points.",
        default="reject",
    ),
    options.choice(
        "--target",
        "auto given flat free",
        "Treatment of the target's shape: given uses X, Y, Z as they are; free estimates with the "
        "camera how the target is bent and printed, which needs 3 views or more; flat does so within its "
        "plane; auto does so if the points support it. Points with columns sX, sY, sZ are adjusted within "
        "these standard deviations, unless given.",
        default="auto",
    ),
]
