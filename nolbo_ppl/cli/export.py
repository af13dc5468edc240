"""`nolbo export`: guide and decoder as ONNX files, for programs without torch."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.inference.posterior.onnx_export import ExportedFiles, export_onnx
from nolbo_ppl.io.output_folder import output_folder

FILES = ("guide.onnx", "decoder.onnx", "model.json")


@dataclass(frozen=True)
class ExportConfig:
    """Guide and decoder as ONNX files with a description beside them (docs/howto/without-torch.md)."""

    out: Path
    """Folder for guide.onnx, decoder.onnx and model.json."""
    model: str = "photo"
    """Name of weights in the package, or a folder with a model of your own."""
    size: tuple[int, int] | None = None
    """Width and height, px, of the images the graph takes, multiples of 32; a square of the network's own side by default."""
    candidates: int = 64
    """Regions of an image that are answered for: those of the greatest objectness."""


def run(config: ExportConfig) -> ExportedFiles:
    """Export a model; the files appear complete or not at all.

    Raises:
        InputError: no such model, a size or number of candidates that cannot be, or no package `onnx`.
    """
    model = load(config.model, "cpu")
    with output_folder(config.out, FILES, is_own=is_result) as folder:
        export_onnx(model, folder, config.size, config.candidates)
    return ExportedFiles(*(config.out / name for name in FILES))


def is_result(folder: Path) -> bool:
    """Whether a folder holds an export that another may replace."""
    return all((folder / name).is_file() for name in FILES)


def main(args: Sequence[str] | None = None) -> None:
    """Parse the command line and export."""
    import tyro

    files = run(tyro.cli(ExportConfig, args=args, prog="nolbo export", description=ExportConfig.__doc__))
    sys.stdout.write("\n".join(str(file) for file in (files.guide, files.decoder, files.description)) + "\n")


if __name__ == "__main__":
    main()
