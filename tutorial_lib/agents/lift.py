"""How a function of one run's tensors becomes a function of S runs' tensors, which are stacked.

The tensors of S runs are stacked along a new first axis, and torch.func.vmap evaluates the function of one
run for all of them at once.
"""

import copy
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import vmap

KINDS = ("parameters", "buffers")
Tensors = dict[str, Tensor]
"""Tensors by name: the parameters and buffers of one network."""


class Place(NamedTuple):
    """Where a network keeps one of its tensors."""

    name: str
    """Its full name in the network, e.g. `net.0.weight`."""
    attributes: dict[str, Any]
    """The attributes of the layer that owns it."""
    attribute: str
    """Its name in that layer, e.g. `weight`."""


class Borrower:
    """A network without tensors of its own: it computes with the parameters and buffers that it is lent.

    torch.func.functional_call does the same, but looks up every name at every call. For networks of profile
    `small` that was an eighth of an update's time.
    """

    def __init__(self, module: nn.Module):
        refuse_hidden_state(module)
        self.module = copy.deepcopy(module)
        self.places: list[Place] = []
        first_name: dict[Tensor, str] = {}  # a tensor that stands in two places is one parameter
        for prefix, layer in self.module.named_modules():
            for own in (layer._parameters, layer._buffers):
                for attribute in [key for key, tensor in own.items() if tensor is not None]:  # no bias: None
                    name = f"{prefix}.{attribute}" if prefix else attribute
                    tensor = own.pop(attribute)
                    assert tensor is not None
                    self.places.append(Place(first_name.setdefault(tensor, name), vars(layer), attribute))

    def lend(self, tensors: Tensors) -> nn.Module:
        """The network with these tensors, by their names, until others are lent."""
        for name, attributes, attribute in self.places:
            attributes[attribute] = tensors[name]
        return self.module


def refuse_hidden_state(module: nn.Module) -> None:
    """Raises ValueError for layers that draw random numbers or change their buffers when they are called."""
    for name, layer in module.named_modules():
        where = f"layer {name or 'itself'!r} ({type(layer).__name__}) of {type(module).__name__}"
        drops = isinstance(layer, nn.modules.dropout._DropoutNd) and layer.p > 0
        if drops or (isinstance(layer, nn.MultiheadAttention) and layer.dropout > 0):
            raise ValueError(
                f"{where} draws a dropout mask by itself: draw it in `draw`, and multiply by it in `losses`"
            )
        if isinstance(layer, nn.modules.batchnorm._NormBase) and layer.track_running_stats:
            raise ValueError(f"{where} changes its buffers at every call: use LayerNorm")


def stacked(modules: list[nn.Module], kind: str) -> Tensors:
    """`kind` ("parameters" or "buffers") of one network in S runs, by name, each (S, ...)."""
    runs = [dict(getattr(module, f"named_{kind}")()) for module in modules]
    return {name: torch.stack([run[name].detach() for run in runs]) for name in runs[0]}


def over_runs(function: Callable, runs: int) -> Callable:
    """`function` of one run's tensors, for S runs: arguments and results get a first axis of S.

    Arguments and results are (nested) dicts of tensors. A single run is computed without vmap, which costs
    time.
    """
    if runs > 1:
        return vmap(function)

    def alone(*arguments):
        # squeeze(0), not x[0]: the backward pass of indexing copies its gradient.
        result = function(*(map_tensors(argument, lambda x: x.squeeze(0)) for argument in arguments))
        return map_tensors(result, lambda x: x.unsqueeze(0))

    return alone


def map_tensors(tree: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """The same nesting of dicts and tuples with `function` applied to every tensor."""
    if isinstance(tree, dict):
        return {key: map_tensors(value, function) for key, value in tree.items()}
    if isinstance(tree, tuple):
        return tuple(map_tensors(value, function) for value in tree)
    return function(tree)


def clip_gradients(parameters: Iterable[Tensor], largest: float) -> None:
    """Scales the gradients of one network, each (S, ...), so that no run's norm exceeds `largest`."""
    gradients = [p.grad for p in parameters if p.grad is not None]
    squares = [g.flatten(1).square().sum(1) if g.ndim > 1 else g.square() for g in gradients]
    norm = torch.stack(squares).sum(0).sqrt()  # (S,)
    factor = (largest / (norm + 1e-6)).clamp(max=1.0)
    for g in gradients:
        g.mul_(factor.view(-1, *[1] * (g.ndim - 1)))


def flat_names(tensors: dict[str, Tensors], prefix: str) -> Iterator[tuple[str, Tensor]]:
    """Every tensor of several networks with the name that files use: `prefix.network.name`."""
    for network, of_network in tensors.items():
        for name, tensor in of_network.items():
            yield f"{prefix}.{network}.{name}", tensor
