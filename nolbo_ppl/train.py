"""`python -m nolbo_ppl.train`: the same as `nolbo train`."""

from nolbo_ppl.cli.train import TrainConfig as TrainConfig
from nolbo_ppl.cli.train import main as main
from nolbo_ppl.cli.train import run as run

if __name__ == "__main__":
    main()
