"""Grids of circles: `lattice` finds and places round marks, `measuring` measures their centres."""
