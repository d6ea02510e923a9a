"""The short script that one would write around OpenCV: ``opencv_script.py POINTS.csv CAMERA.yaml``."""

import csv
import sys

import cv2
import numpy as np

points, camera = sys.argv[1:]
cv2.setNumThreads(1)
with open(points) as file:
    lines = file.read().splitlines()
width, height = next(line.split()[2:] for line in lines if line.startswith("# image_size"))
views: dict[str, list[list[float]]] = {}
for row in csv.DictReader(line for line in lines if not line.startswith("#")):
    views.setdefault(row["view"], []).append([float(row[name]) for name in ("X", "Y", "Z", "u", "v")])
tables = [np.array(rows, dtype=np.float32) for rows in views.values()]
world, pixels = (
    [np.ascontiguousarray(table[:, part]) for table in tables] for part in (np.s_[:3], np.s_[3:])
)
rms, K, distortion, R, t = cv2.calibrateCamera(world, pixels, (int(width), int(height)), None, None)
sys.stderr.write(f"rms {rms:.4f} px\n{K}\n{distortion}\n")
storage = cv2.FileStorage(camera, cv2.FILE_STORAGE_WRITE)
for name, value in (("camera_matrix", K), ("distortion", distortion), ("R", np.array(R)), ("t", np.array(t))):
    storage.write(name, value)
storage.release()
