"""Numbers of the paper's tables, to stand beside what is measured here."""

from __future__ import annotations

CATEGORIES = (
    "aeroplane", "bicycle", "boat", "bottle", "bus", "car", "chair", "diningtable", "motorbike", "sofa", "train", "tvmonitor",
)  # fmt: skip
"""Columns of Table 1."""

ACCURACY: dict[str, tuple[float, ...]] = {
    "Tulsiani & Malik 2015": (0.81, 0.77, 0.59, 0.93, 0.98, 0.89, 0.80, 0.62, 0.88, 0.82, 0.80, 0.80),
    "Mousavian et al. 2017": (0.78, 0.83, 0.57, 0.93, 0.94, 0.90, 0.80, 0.68, 0.86, 0.82, 0.82, 0.85),
    "NOLBO, the paper": (0.83, 0.86, 0.70, 0.90, 0.95, 0.96, 0.95, 0.83, 0.83, 0.98, 0.94, 0.91),
}
"""Acc_pi/6 of Table 1, by row."""

MEDIAN_ERROR: dict[str, tuple[float, ...]] = {
    "Tulsiani & Malik 2015": (13.8, 17.7, 21.3, 12.9, 5.8, 9.1, 14.8, 15.2, 14.7, 13.7, 8.7, 15.4),
    "Mousavian et al. 2017": (13.6, 12.5, 22.8, 8.3, 3.1, 5.8, 11.9, 12.5, 12.3, 12.8, 6.3, 11.9),
    "NOLBO, the paper": (14.5, 16.5, 17.8, 10.5, 10.1, 8.6, 11.4, 13.7, 16.9, 10.7, 9.2, 14.1),
}
"""MedErr of Table 1, degrees. The mean of the paper's own row is 12.8; it prints 11.7."""

ATE: dict[str, float] = {
    "multi16": 25.93, "multi128": 28.66, "single16": 52.79, "ae16": 37.88, "tlnet16": 62.56, "vvae16": 64.78, "vo": 30.75,
}  # fmt: skip
"""Absolute trajectory error of Table 2, without a unit there, by row."""

RPE: dict[str, float] = {
    "multi16": 29.88, "multi128": 31.71, "single16": 65.03, "ae16": 40.83, "tlnet16": 73.02, "vvae16": 72.07, "vo": 35.40,
}  # fmt: skip
"""Relative pose error of Table 2, without a unit there, by row."""

ESTEP_RATIO = 5.0
"""The paper's claim: latents of 16 dimensions are up to so many times faster than those of 128."""
