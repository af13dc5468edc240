"""Training: configuration, stages, data, checkpoints, validation and calibration."""
