"""Names and numbers of COCO's categories, and how tall such things are."""

from __future__ import annotations

_NAMES = """person bicycle car motorcycle airplane bus train truck boat traffic_light fire_hydrant stop_sign parking_meter bench
bird cat dog horse sheep cow elephant bear zebra giraffe backpack umbrella handbag tie suitcase frisbee skis snowboard
sports_ball kite baseball_bat baseball_glove skateboard surfboard tennis_racket bottle wine_glass cup fork knife spoon
bowl banana apple sandwich orange broccoli carrot hot_dog pizza donut cake chair couch potted_plant bed dining_table
toilet tv laptop mouse remote keyboard cell_phone microwave oven toaster sink refrigerator book clock vase scissors
teddy_bear hair_drier toothbrush"""
COCO_NAMES = _NAMES.split()
"""The 80 categories of COCO in order."""
_ABSENT = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
COCO_IDS = dict(zip((k for k in range(1, 91) if k not in _ABSENT), COCO_NAMES))
"""COCO's category numbers, which leave ten out."""
HEIGHTS: dict[str, tuple[float, float]] = {
    "person": (1.65, 0.2),
    "bicycle": (1.05, 0.12),
    "car": (1.53, 0.13),
    "motorcycle": (1.2, 0.15),
    "bus": (3.1, 0.3),
    "truck": (2.9, 0.6),
    "chair": (0.9, 0.12),
    "couch": (0.85, 0.12),
    "dining_table": (0.75, 0.08),
    "bottle": (0.26, 0.06),
    "cup": (0.1, 0.02),
    "stop_sign": (0.75, 0.08),
    "fire_hydrant": (0.75, 0.12),
    "teddy_bear": (0.35, 0.12),
}
"""Height and its standard deviation by category, m: rough everyday values; those of one's own objects are better."""
