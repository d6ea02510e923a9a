"""The network and the methods beside it, on the same points."""
