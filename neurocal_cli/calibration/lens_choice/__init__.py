"""Selection and estimation of the distortion model, also from straight lines; undistortion."""
