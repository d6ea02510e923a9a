"""Selection and estimation of the distortion model, also from the images of straight lines alone."""
