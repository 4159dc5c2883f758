"""Calibration of a real scanner: camera, laser plane, IMU, and how far each can be trusted.

Nothing here is needed while scanning; only ``vli calibrate`` and the tests use it.
"""
