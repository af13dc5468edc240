"""Noise of odometry and detections, estimated where it is not stated."""

from nolbo_ppl._moved import moved_names

__getattr__ = moved_names("nolbo_ppl.inference.slam.noise", "nolbo_ppl.inference.slam.noise.noise_estimation")
