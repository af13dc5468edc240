"""Ray casting, shading, materials and smooth edges."""
