"""Data: shapes, scenes, data sets and batches; trajectories, observations and converters."""
