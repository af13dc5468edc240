"""nolbo_ppl: calibrated posteriors over every object of an image, and object SLAM by expectation-maximisation on them."""

from __future__ import annotations

__version__ = "0.1.0"
