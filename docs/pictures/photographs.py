"""The sample photographs, small, on one sheet: ``photographs.jpg``."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
SAMPLES = HERE.parents[1] / "sample_data"
ACROSS, SIZE = 4, (320, 240)  # pictures in a row, and the size of each [px]


def main() -> None:
    small = [
        cv2.resize(cv2.imread(str(file)), SIZE, interpolation=cv2.INTER_AREA)
        for file in sorted(SAMPLES.glob("photo*.jpg"))
    ]
    rows = [np.hstack(small[k : k + ACROSS]) for k in range(0, len(small), ACROSS)]
    cv2.imwrite(str(HERE / "photographs.jpg"), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()
