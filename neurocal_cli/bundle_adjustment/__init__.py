"""The pixel error (3) of all views: its unknowns, minimum and covariance, and what parts of the data say."""
