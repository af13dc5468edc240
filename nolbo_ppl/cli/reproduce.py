"""`nolbo reproduce TABLE --out DIR`: the paper's tables and figures, on generated data or a folder of one's own.

table1: viewpoints with ground truth boxes; table2: SLAM with what each network observes; pr: precision and recall of 3D
reconstruction; tsne: maps of the latent spaces; mle: classification of shapes over the prior means; estep: time of the E-step
by the dimensions of the latent. Networks that are needed are trained first, alike, and kept in the output folder.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import write_json
from nolbo_ppl.io.output_folder import locked
from nolbo_ppl.reproduction.budgets import ReproduceConfig
from nolbo_ppl.reproduction.result_table import ResultTable


def reproduce_table1(config: ReproduceConfig) -> ResultTable:
    """Table 1."""
    from nolbo_ppl.reproduction.tables_of_objects import viewpoint_table

    return viewpoint_table(config)


def reproduce_table2(config: ReproduceConfig) -> ResultTable:
    """Table 2."""
    from nolbo_ppl.reproduction.slam_table import slam_table

    return slam_table(config)


def reproduce_pr(config: ReproduceConfig) -> ResultTable:
    """The figure of precision and recall; `pr.png` beside the table."""
    from nolbo_ppl.reproduction.tables_of_objects import reconstruction
    from nolbo_ppl.viz.reproduction_plots import draw_reconstruction_curves
    from nolbo_ppl.viz.style import save

    table, curves = reconstruction(config)
    drawn = draw_reconstruction_curves({name: (curve.recall, curve.precision) for name, curve in curves.items()})
    save(drawn, config.out / "pr.png")
    return table


def reproduce_tsne(config: ReproduceConfig) -> ResultTable:
    """The figure of latent spaces; `tsne.png` beside the table."""
    from nolbo_ppl.reproduction.tables_of_objects import latent_maps
    from nolbo_ppl.viz.reproduction_plots import draw_latent_maps
    from nolbo_ppl.viz.style import save

    table, maps, categories = latent_maps(config)
    save(draw_latent_maps(maps, categories), config.out / "tsne.png")
    return table


def reproduce_mle(config: ReproduceConfig) -> ResultTable:
    """Classification by maximum likelihood."""
    from nolbo_ppl.reproduction.mle_table import mle_table

    return mle_table(config)


def reproduce_estep(config: ReproduceConfig) -> ResultTable:
    """Time of the E-step."""
    from nolbo_ppl.reproduction.estep_time import e_step_table

    return e_step_table(config)


TARGETS: dict[str, Callable[[ReproduceConfig], ResultTable]] = {
    "table1": reproduce_table1,
    "table2": reproduce_table2,
    "pr": reproduce_pr,
    "tsne": reproduce_tsne,
    "mle": reproduce_mle,
    "estep": reproduce_estep,
}
"""What can be reproduced, by name."""


def run(target: str, config: ReproduceConfig) -> ResultTable:
    """Compute a table, write `TARGET.md`, `TARGET.csv`, `TARGET.json` (the configuration) and its pictures.

    Raises:
        InputError: unknown target, data that does not suit it, or another process writes into the folder.
    """
    if target not in TARGETS:
        raise input_error("nothing to reproduce of that name", got=target, expected=f"one of {list(TARGETS)}")
    if config.threads:
        import torch

        torch.set_num_threads(config.threads)
    with locked(config.out):
        table = TARGETS[target](config)
        table.write(config.out, target)
        write_json(config.out / f"{target}.json", {name: _plain(value) for name, value in vars(config).items()})
    return table


def _plain(value: object) -> object:
    return str(value) if isinstance(value, Path) else list(value) if isinstance(value, tuple) else value


def main(args: Sequence[str] | None = None) -> None:
    """Parse the command line, reproduce, and print the table."""
    import tyro

    given = list(sys.argv[1:] if args is None else args)
    names = [name for name in given[:1] if not name.startswith("-")]
    if given[:1] and not names:
        given = ["table1", *given]  # --help of any of them
        names = ["table1"]
    if not names:
        raise input_error("nothing to reproduce", got="no name", expected=f"one of {list(TARGETS)}")
    if names[0] not in TARGETS:
        raise input_error("nothing to reproduce of that name", got=names[0], expected=f"one of {list(TARGETS)}")
    config = tyro.cli(ReproduceConfig, args=given[1:], prog=f"nolbo reproduce {names[0]}", description=__doc__)
    sys.stdout.write(run(names[0], config).markdown())


if __name__ == "__main__":
    main()
