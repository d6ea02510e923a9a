"""From random weights to a camera: a network for each view, one common W, and a check for other minima."""
