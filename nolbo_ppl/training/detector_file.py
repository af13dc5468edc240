"""Read the public ONNX file of YOLOX-nano into the guide's own module; needs the extra `onnx`."""

from __future__ import annotations

import os

import numpy as np
import torch

from nolbo_ppl.errors import input_error
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
