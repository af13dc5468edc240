"""The generative story, the amortised guide, and the networks and distributions they are made of."""
