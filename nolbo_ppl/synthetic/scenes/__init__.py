"""Random scenes: composed, rendered, labelled."""
