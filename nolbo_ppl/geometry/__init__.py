"""Geometry: rotations and viewpoints, cameras, boxes, voxels."""
