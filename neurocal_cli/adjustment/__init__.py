"""Bundle adjustment: minimum of the reprojection error (3), covariance, cross-validation, observability."""
