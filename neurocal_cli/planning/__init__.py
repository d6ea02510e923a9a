"""Which views to photograph next."""
