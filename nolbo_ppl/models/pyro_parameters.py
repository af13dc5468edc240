"""Parameters of plain torch modules as Pyro's handlers see them: an optimiser finds them, no store keeps them."""

from __future__ import annotations

from typing import Any

from pyro.distributions import constraints
from pyro.poutine.runtime import am_i_wrapped, effectful
from torch import Tensor, nn


def declare_parameters(name: str, module: nn.Module) -> None:
    """State every trainable parameter of a module to the handlers that run: what `SVI` trains is what it hears of.

    `pyro.module` would keep them in Pyro's global store, by name: a second model of the same process would then hand the
    first one's parameters to the optimiser and train nothing, without a word. As with `PyroModule` under
    `pyro.settings.set(module_local_params=True)`, the module's own parameters are the only ones there are. Handlers that
    replace parameters (`poutine.lift`, `poutine.substitute`) are not obeyed: a plain module computes with its own.

    Args:
        name: prefix of the parameters' names, `name.path.of.the.parameter`.
        module: a module; parameters that require no gradient are left out.

    Example:
        >>> from pyro import poutine
        >>> with poutine.trace(param_only=True) as heard:
        ...     declare_parameters("layer", nn.Linear(2, 1))
        >>> list(heard.trace.nodes)
        ['layer.weight', 'layer.bias']
    """
    if not am_i_wrapped():
        return
    for path, parameter in module.named_parameters():
        if parameter.requires_grad:
            _declare(f"{name}.{path}", parameter)


def _declare(name: str, parameter: nn.Parameter) -> None:
    value: Any = parameter.detach()  # shares the numbers; what follows stays off the parameter itself, which is copied
    value.unconstrained = lambda: parameter

    def stated(*_: Any, **__: Any) -> Tensor:
        return value

    effectful(stated, type="param")(name, parameter, constraint=constraints.real, name=name)
