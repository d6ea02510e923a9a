"""Which grid is which plane of a board, and which of its points is which."""
