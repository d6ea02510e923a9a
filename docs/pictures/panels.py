"""What ``--plot`` draws of the sample photographs: the page of panels, each panel, and those of bad fits."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from neurocal_cli import Board, Correspondences, calibrate, detect_points, read_image
from neurocal_cli.calibration.drift import find_drift
from neurocal_cli.commands.show.camera_panels import Subject, draw_target
from neurocal_cli.commands.show.drift_report import draw_drift
from neurocal_cli.commands.show.plot_pages import draw_camera
from neurocal_cli.detection.overlay import draw_detection

HERE = Path(__file__).resolve().parent
SAMPLES = HERE.parents[1] / "sample_data"
PANELS = {
    "panel-residuals.png": "residuals",
    "panel-scatter.png": "scatter",
    "panel-coverage.png": "coverage",
    "panel-uncertainty.png": "uncertainty",
    "panel-poses.png": "poses",
    "panel-views.png": "views",
    "panel-learning.png": "learning",
}


BOARD = Board.single(9, 6, 25.0)
OVERLAY = slice(330, 730), slice(150, 790)  # rows and columns of the overlay that are shown


def photographed() -> Correspondences:
    """Points of the sample photographs."""
    files = sorted(SAMPLES.glob("photo*.jpg"))
    return Correspondences.from_detections(
        {file.stem: detect_points(read_image(str(file)).grey, BOARD) for file in files}
    )


def main() -> None:
    points = photographed()
    found = calibrate(points, skew=False)
    flat = calibrate(points, skew=False, target="given")
    simple = calibrate(points, skew=False, distortion="none", target="given")
    assert found.target is not None
    assert found.image_size is not None
    pictures = {"panels.png": draw_camera(Subject.of(found))}
    pictures |= {file: draw_camera(Subject.of(found), panel=name) for file, name in PANELS.items()}
    pictures |= {
        "bad-board.png": draw_camera(Subject.of(flat), panel="residuals"),
        "bad-lens.png": draw_camera(Subject.of(simple), panel="residuals"),
        "bent-board.png": draw_target(found.target, found.unit),
        "two-cameras-differ.png": draw_drift({"": (find_drift(found, flat), found.image_size)}),
    }
    for name, content in pictures.items():
        (HERE / name).write_bytes(content)
    # Below each other, for a screen that is too narrow for the page.
    narrow = Image.fromarray(
        np.vstack([np.asarray(Image.open(HERE / file).convert("RGB")) for file in PANELS])
    )
    narrow.quantize(96).save(HERE / "panels-narrow.png", optimize=True)
    grey = read_image(str(SAMPLES / "photo02.jpg")).grey
    overlay = draw_detection(grey, detect_points(grey, BOARD))[OVERLAY]
    cv2.imwrite(str(HERE / "overlay.jpg"), overlay[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()
