"""`nolbo_ppl.train(config)` trains; `python -m nolbo_ppl.train` is the same as `nolbo train`.

Example:
    >>> import nolbo_ppl, pathlib, tempfile
    >>> from nolbo_ppl.synthetic.dataset_writer import write_scenes
    >>> from nolbo_ppl.synthetic.scenes.scene_config import preset
    >>> from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> _ = write_scenes(folder / "scenes", SceneGenerator(preset("easy"), seed=5), 12)
    >>> config = nolbo_ppl.TrainConfig(
    ...     folder / "run", preset="nano", scenes=(folder / "scenes",), batch=4, workers=1,
    ...     shape_steps=2, single_steps=0, scene_steps=2)
    >>> nolbo_ppl.train(config).steps
    4
"""

import sys
from types import ModuleType

from nolbo_ppl.cli.train import TrainConfig as TrainConfig
from nolbo_ppl.cli.train import TrainSummary as TrainSummary
from nolbo_ppl.cli.train import main as main
from nolbo_ppl.cli.train import run as run
from nolbo_ppl.progress import show_progress


class _CallableModule(ModuleType):
    """The module and the function have one name: whoever imports the module can still call it."""

    def __call__(self, config: TrainConfig) -> TrainSummary:
        """Train as configured; returns when the model is written (`nolbo_ppl.training.trainer.run`)."""
        return run(config)


sys.modules[__name__].__class__ = _CallableModule

if __name__ == "__main__":
    show_progress()
    main()
