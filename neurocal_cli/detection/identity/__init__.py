"""Identifying grids with planes of a board, and their vertices with its vertices."""
