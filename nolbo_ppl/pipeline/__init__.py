"""The mission: images in, a corrected trajectory, a map of objects with shapes, figures and a report out."""
