"""Queries on the amortised posterior: images in, posteriors of objects out."""
