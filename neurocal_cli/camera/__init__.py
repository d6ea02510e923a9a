"""The camera: intrinsic matrix, pose, projection, and lens distortion with its monotonic domain."""
