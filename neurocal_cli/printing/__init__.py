"""Boards on paper: where each square, fold and ruler of a printed target lies, in millimetres."""
