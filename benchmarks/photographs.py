"""The photographs behind generated scenes: which ones, and folders of those for training and for evaluation.

    python benchmarks/photographs.py --images val2017 --out photographs

`photographs.json` names them. A photograph that shows a car is no background for a detector of cars: as an unlabelled
object it would be learnt as background, and counted as a false detection. Those that show an object of one of the twelve
categories (48 of 128, sorted by eye) are left out.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import tyro

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_json

LIST = Path(__file__).with_suffix(".json")


@dataclass(frozen=True)
class Arguments:
    """What to copy where."""

    images: Path
    """Folder of COCO's val 2017 images."""
    out: Path
    """Folder that gets `train` and `test`."""


def main(arguments: Arguments) -> None:
    """Copy the photographs of each part.

    Raises:
        InputError: an image is missing.
    """
    listed = read_json(LIST)
    for part in ("train", "test"):
        folder = arguments.out / part
        folder.mkdir(parents=True, exist_ok=True)
        for name in listed[part]:
            source = arguments.images / name
            if not source.is_file():
                raise input_error("no such photograph", file=source, expected=listed["source"])
            shutil.copyfile(source, folder / name)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
