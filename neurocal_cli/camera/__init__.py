"""The camera: its intrinsic matrix and pose, the lens's distortion, and where that is monotonic."""
