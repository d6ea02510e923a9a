"""What a camera observes: known points and their pixels, and the targets on which they lie."""
