"""Edges and vertices of a grid, fitted to all the pixels around them."""
