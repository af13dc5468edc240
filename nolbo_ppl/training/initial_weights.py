"""What networks start from: all the weights of other ones, their features, or all but what belongs to the shape latent."""

from __future__ import annotations

import os

import torch
from jaxtyping import Int
from torch import Tensor

from nolbo_ppl.errors import input_error
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_network import scene_weights_of
from nolbo_ppl.training.detector_file import read_detector

LOOK = "guide.shape_look."
"""What the names of weights of a look at shapes begin with."""


def adopt(model: Nolbo, initial: Nolbo, detector: str | os.PathLike[str] | None) -> None:
    """Give a model the weights of another one, and those of a detector or of a look at shapes that the other has not.

    Raises:
        InputError: the model has a detector, the other has none, and no file is given; or the file cannot be used.
    """
    state = initial.state_dict()
    if model.config.shape_look and not initial.config.shape_look:  # its encoder starts from the guide's
        own = {f"{LOOK}encoder.{name}": value for name, value in initial.guide.encoder.state_dict().items()}
        state |= {name: value for name, value in model.state_dict().items() if name.startswith(LOOK)} | own
    if model.config.detector and not initial.config.detector:
        if detector is None:
            raise input_error("the preset photo without a detector", do="give --detector yolox_nano.onnx")
        own_state = model.state_dict()
        state = {**own_state, **state, **scene_weights_of(state, list(own_state))}
    model.load_state_dict(state)
    if detector is not None:
        model.guide.get_submodule("detector").load_state_dict(read_detector(detector).state_dict())


SHAPE_FEATURES = ("story.decoder.layers.", "shape_guide.encoder.layers.")
"""Convolutions of the shape networks."""
FEATURES = ("guide.encoder.", *SHAPE_FEATURES)
"""Parts of the networks that features are: what depends neither on the latent nor on the method."""


def adopt_features(model: Nolbo, initial: Nolbo, parts: tuple[str, ...] = FEATURES) -> None:
    """Give a model the features of another one; heads, latent and prior networks stay as they are.

    Args:
        model: the networks to change.
        initial: where the features come from.
        parts: which ones, by the beginnings of their names.

    Raises:
        InputError: features of another size.
    """
    own, given = model.state_dict(), initial.state_dict()
    names = [name for name in {**own, **given} if name.startswith(parts)]
    wrong = sorted(name for name in names if name not in own or name not in given or own[name].shape != given[name].shape)
    if wrong:
        got = f"{len(wrong)} tensors of other shapes, {wrong[0]}"
        raise input_error("features of the initial weights", got=got, do="give --preset of theirs")
    model.load_state_dict({**own, **{name: given[name] for name in names}})


def _rows_but_latent(model: Nolbo, outputs: int) -> Int[Tensor, " rows"]:
    """Rows of an output layer of the guide's head that do not describe the shape latent, predictor by predictor.

    Args:
        model: the networks.
        outputs: outputs of the layer: of a cell for all predictors, or of the RoI refinement, which leaves the box out.
    """
    sizes = list(model.guide.head.sizes)
    if outputs == sum(sizes) - sizes[4]:
        sizes[4] = 0
    starts = torch.arange(0, outputs, sum(sizes))
    kept = torch.cat((torch.arange(sizes[0]), torch.arange(sizes[0] + sizes[1], sum(sizes))))
    return (starts[:, None] + kept).flatten()


def adopt_detection(model: Nolbo, initial: Nolbo) -> None:
    """Give a model the features of another one, and of its head all that does not describe the shape latent.

    Objectness, box, range, category and viewpoint begin as the other model states them, whatever the method and the
    dimensions of the latent; the outputs of the latent, the prior networks and the shape posterior stay as they are.

    Raises:
        InputError: networks of other sizes.
    """
    adopt_features(model, initial)
    head = "guide.head."
    own = {name: value for name, value in model.state_dict().items() if name.startswith(head)}
    given = {name: value for name, value in initial.state_dict().items() if name.startswith(head)}
    adopted: dict[str, Tensor] = {}
    for name, value in own.items():
        last = name.startswith((f"{head}outputs.6.", f"{head}outputs.weight", f"{head}glimpse.judge.3."))
        rows = (
            (_rows_but_latent(model, len(value)), _rows_but_latent(initial, len(given[name]))) if last and name in given else None
        )
        if name not in given or (value.shape != given[name].shape if rows is None else len(rows[0]) != len(rows[1])):
            raise input_error("the head of the initial weights", got=f"{name} of another shape", do="give --preset of theirs")
        adopted[name] = given[name] if rows is None else value.index_copy(0, rows[0], given[name][rows[1]])
    model.load_state_dict({**model.state_dict(), **adopted})
