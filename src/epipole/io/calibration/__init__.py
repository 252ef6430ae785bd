"""Camera calibrations: OpenCV, Kalibr, mrcal, datasets, and calibration files found next to a sequence."""
