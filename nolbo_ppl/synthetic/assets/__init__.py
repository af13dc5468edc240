"""Where scenes draw their shapes from: parametric families and CAD meshes."""
