"""Figures of merit: detection, viewpoint, shape, calibration, intervals, trajectories and association."""
