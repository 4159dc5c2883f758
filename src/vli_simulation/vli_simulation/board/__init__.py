"""Calibration data with truth: images of a target, a bag of the sensor moving before it, and the IMU at rest."""
