"""`nolbo train`: stochastic variational inference in stages, from shapes to single objects to scenes.

Stages (NOLBO, training details; docs/training.md): the shape autoencoder (decoder, prior networks, 3D encoder); the
guide on images of one object; the guide on scenes, decoder and prior frozen. Every batch is a function of the seed and
the step, checkpoints hold all that a step changes, and a killed run goes on exactly where its last checkpoint stands.
Started by `torchrun`, several processes or machines share each batch.

The paper's own programme on its data sets: `nolbo train --stage imagenet|viewpoint|vae|single|multi --help`.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence

from nolbo_ppl.training.photograph_fit import PARTS
from nolbo_ppl.training.train_config import TrainConfig as TrainConfig
from nolbo_ppl.training.trainer import TrainSummary as TrainSummary
from nolbo_ppl.training.trainer import run as run


def main(args: Sequence[str] | None = None) -> None:
    """Parse the command line and train."""
    import tyro

    given = list(sys.argv[1:] if args is None else args)
    if any(word == "--stage" or word.startswith("--stage=") for word in given):
        from nolbo_ppl.training.paper_config import PaperConfig
        from nolbo_ppl.training.paper_stages import run_paper

        stage = tyro.cli(PaperConfig, args=given, prog="nolbo train", description=PaperConfig.__doc__)
        sys.stdout.write(json.dumps(dataclasses.asdict(run_paper(stage)), indent=2, default=str) + "\n")
        return
    config = tyro.cli(TrainConfig, args=given, prog="nolbo train", description=__doc__)
    summary = run(config)
    sys.stdout.write(json.dumps(dataclasses.asdict(summary), indent=2, default=str) + "\n")
    if config.photographs is not None:
        from nolbo_ppl.cli.evaluate import EvaluateConfig, photograph_table, run_photographs

        model = str(config.out / "model")
        options = EvaluateConfig(
            config.out / "photographs", model, photographs=config.photographs, part=(1, PARTS), pictures=False
        )
        sys.stdout.write(photograph_table(run_photographs(options), model) + "\n")


if __name__ == "__main__":
    main()
