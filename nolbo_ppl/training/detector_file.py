"""Read the public ONNX file of YOLOX-nano into the guide's own module; needs the extra `onnx`."""

from __future__ import annotations

import os

import numpy as np
import torch

from nolbo_ppl.errors import input_error
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.yolox import ScaledConv, YoloxNano


def read_detector(path: str | os.PathLike[str]) -> YoloxNano:
    """YOLOX-nano with the weights of its ONNX file.

    The file's convolutions stand in the order in which the network computes them, which is the order of the module's own:
    each takes the next kernel, and any difference of shape or number is an error.

    Raises:
        InputError: `onnx` is not installed, or the file is missing or of another network.
    """
    try:
        import onnx
        from onnx import numpy_helper
    except ImportError:
        raise input_error("detector file", got="no package `onnx`", do="pip install 'nolbo-ppl[onnx]'") from None
    try:
        graph = onnx.load(os.fspath(path)).graph
    except (OSError, ValueError, onnx.onnx_cpp2py_export.checker.ValidationError) as error:
        raise input_error("detector file", got=error, expected="the ONNX file of YOLOX-nano", file=path) from None
    except Exception as error:  # protobuf's own exceptions have no common base
        raise input_error("detector file", got=type(error).__name__, expected="the ONNX file of YOLOX-nano", file=path) from None
    tensors = {one.name: np.array(numpy_helper.to_array(one), dtype=np.float32) for one in graph.initializer}
    kernels = [
        (tensors[node.input[1]], tensors[node.input[2]])
        for node in graph.node
        if node.op_type == "Conv" and len(node.input) == 3 and {*node.input[1:]} <= set(tensors)
    ]
    model = YoloxNano()
    units = [unit for unit in model.modules() if isinstance(unit, ScaledConv)]
    if len(units) != len(kernels):
        raise input_error(
            "detector file", got=f"{len(kernels)} convolutions", expected=f"the {len(units)} of YOLOX-nano", file=path
        )
    first = kernels[0][0]  # over the four phases of 2 x 2 px, each in the order blue, green, red
    kernels[0] = (np.ascontiguousarray(first.reshape(len(first), 4, 3, 3, 3)[:, :, ::-1]).reshape(first.shape), kernels[0][1])
    for unit, (kernel, bias) in zip(units, kernels):
        unit.set_kernel(torch.from_numpy(kernel), torch.from_numpy(bias))
    return model.eval()


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
        state = {**model.state_dict(), **state}
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
