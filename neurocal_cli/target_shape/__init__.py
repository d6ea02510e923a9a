"""The target as it is: offsets of its points from where its file has them, found with the camera."""
