"""PostScript under the name of an image: nothing is run, by whatever verb it is read."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.images import open_depth_image, open_image

PICKLES = ("pickle.load", "torch.load(", "allow_pickle=True")
POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 96 48\n%%EndComments\n0 0 96 48 rectfill\nshowpage\n%%EOF\n"


def test_an_interpreter_first_in_the_path_is_not_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The `gs` that is found writes down that it was called; Pillow alone, without named decoders, calls it."""
    programs, log = tmp_path / "programs", tmp_path / "log"
    programs.mkdir()
    program = programs / "gs"
    program.write_text(f'#!/bin/sh\necho "$@" >> "{log}"\nexit 1\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    for name in ("a.png", "a.jpg", "a.tif", "a.eps"):
        (tmp_path / name).write_bytes(POSTSCRIPT)
        for read in (open_image, open_depth_image):
            with pytest.raises(InputError, match=name):
                read(tmp_path / name)
    assert not log.exists()
    import PIL.EpsImagePlugin

    monkeypatch.setattr(PIL.EpsImagePlugin, "gs_binary", None)
    with pytest.raises(Exception, match=r".*"), Image.open(tmp_path / "a.png") as opened:
        opened.load()
    assert log.exists(), "the test would see it"


def test_modules_open_images_in_one_place() -> None:
    """`Image.open` and `cv2.imread` stand in the reader of images alone."""
    package = Path(__file__).resolve().parents[2] / "nolbo_ppl"
    found = [
        str(path.relative_to(package))
        for path in sorted(package.rglob("*.py"))
        if any(word in path.read_text(encoding="utf-8") for word in ("Image.open(", "imread(", "imageio"))
    ]
    assert found == ["io/images.py"]
    loads = [
        str(path.relative_to(package))
        for path in sorted(package.rglob("*.py"))
        if any(word in path.read_text(encoding="utf-8") for word in PICKLES)
    ]
    assert not loads


def test_a_good_image_is_still_read(tmp_path: Path) -> None:
    Image.fromarray(np.full((4, 5, 3), 7, np.uint8)).save(tmp_path / "a.png")
    assert open_image(tmp_path / "a.png").shape == (4, 5, 3)
