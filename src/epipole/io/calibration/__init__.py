"""Camera calibrations: OpenCV, Kalibr, mrcal, datasets, and those that lie beside a sequence."""
