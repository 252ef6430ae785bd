"""Two views: fundamental, essential and homography matrices, model selection, verification of pairs."""
