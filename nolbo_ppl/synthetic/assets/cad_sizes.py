"""Typical sizes of objects, for CAD models that come without a unit."""

from __future__ import annotations

from collections.abc import Mapping

from nolbo_ppl.errors import input_error

DEFAULT_DIAGONAL = 1.0
"""Box diagonal in metres of a category that is not in the table."""

TYPICAL_DIAGONAL: dict[str, float] = {
    # PASCAL3D+
    "aeroplane": 45.0,
    "bicycle": 1.95,
    "boat": 8.0,
    "bottle": 0.28,
    "bus": 12.0,
    "car": 4.9,
    "chair": 1.2,
    "diningtable": 1.9,
    "motorbike": 2.4,
    "sofa": 2.3,
    "train": 20.0,
    "tvmonitor": 0.9,
    # ObjectNet3D
    "ashtray": 0.18,
    "backpack": 0.6,
    "basket": 0.5,
    "bed": 2.7,
    "bench": 1.8,
    "blackboard": 2.2,
    "bookshelf": 2.1,
    "bucket": 0.45,
    "cabinet": 1.5,
    "calculator": 0.18,
    "camera": 0.2,
    "can": 0.15,
    "cap": 0.35,
    "cellphone": 0.16,
    "clock": 0.35,
    "coffee_maker": 0.45,
    "comb": 0.2,
    "computer": 0.65,
    "cup": 0.15,
    "desk_lamp": 0.6,
    "dishwasher": 1.2,
    "door": 2.3,
    "eraser": 0.07,
    "eyeglasses": 0.22,
    "fan": 0.8,
    "faucet": 0.35,
    "filing_cabinet": 1.3,
    "fire_extinguisher": 0.55,
    "fish_tank": 0.9,
    "flashlight": 0.2,
    "fork": 0.2,
    "guitar": 1.1,
    "hair_dryer": 0.32,
    "hammer": 0.35,
    "headphone": 0.28,
    "helmet": 0.4,
    "iron": 0.34,
    "jar": 0.22,
    "kettle": 0.35,
    "key": 0.07,
    "keyboard": 0.48,
    "knife": 0.28,
    "laptop": 0.45,
    "lighter": 0.09,
    "mailbox": 1.1,
    "microphone": 0.25,
    "microwave": 0.65,
    "mouse": 0.13,
    "paintbrush": 0.25,
    "pan": 0.5,
    "pen": 0.15,
    "pencil": 0.18,
    "piano": 2.2,
    "pillow": 0.7,
    "plate": 0.36,
    "pot": 0.45,
    "printer": 0.65,
    "racket": 0.75,
    "refrigerator": 2.0,
    "remote_control": 0.2,
    "rifle": 1.1,
    "road_pole": 1.0,
    "satellite_dish": 1.3,
    "scissors": 0.22,
    "screwdriver": 0.22,
    "shoe": 0.33,
    "shovel": 1.2,
    "sign": 2.4,
    "skate": 0.4,
    "skateboard": 0.85,
    "slipper": 0.3,
    "speaker": 0.6,
    "spoon": 0.2,
    "stapler": 0.17,
    "stove": 1.2,
    "suitcase": 0.85,
    "teapot": 0.3,
    "telephone": 0.3,
    "toaster": 0.4,
    "toilet": 0.95,
    "toothbrush": 0.19,
    "trash_bin": 0.75,
    "trophy": 0.4,
    "tub": 1.9,
    "vending_machine": 2.2,
    "washing_machine": 1.2,
    "watch": 0.12,
    "wheelchair": 1.5,
}
"""Box diagonal in metres by category: round numbers for a common specimen, good to about a third."""


def typical_diagonal(category: str, diagonals: Mapping[str, float] | None = None) -> float:
    """Box diagonal in metres: the caller's own figure, else the table's, else `DEFAULT_DIAGONAL`.

    Raises:
        InputError: the caller's figure is not a positive number.
    """
    value = (diagonals or {}).get(category, TYPICAL_DIAGONAL.get(category, DEFAULT_DIAGONAL))
    if not 0 < value < float("inf"):
        raise input_error(f"box diagonal of {category}", got=value, expected="a positive number of metres")
    return float(value)
