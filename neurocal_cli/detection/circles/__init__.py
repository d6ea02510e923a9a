"""Grids of circles: `blobs` finds round marks, `lattice` places them, `fitting` measures their centres."""
