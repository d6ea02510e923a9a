"""From random weights to a camera: a network for each view, one W for all, and other minima in doubt."""
