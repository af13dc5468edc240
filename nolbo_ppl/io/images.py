"""Image files: which names are images."""

from __future__ import annotations

PICTURE_SUFFIXES: tuple[str, ...] = (".jpg", ".jpeg", ".png", ".bmp", ".webp")
"""Photographs and pictures as they are shared."""
IMAGE_SUFFIXES: tuple[str, ...] = (*PICTURE_SUFFIXES, ".ppm", ".pgm", ".tif", ".tiff")
"""Frames of a sequence: cameras and data sets write portable maps and TIFF, too."""
