"""Turns a function of one run's tensors into a function of the stacked tensors of S runs.

The tensors of S runs are stacked along a new first axis, and torch.func.vmap computes the function of one run
for all of them at once.
"""

import copy
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import vmap

KINDS = ("parameters", "buffers")
"""The two kinds of tensors that a network has."""
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
    """A network without its own tensors. It computes with the parameters and buffers that it is lent.

    torch.func.functional_call does the same, but looks up every name at every call. With the networks of
    profile `small` this took 1/8 of the time of an update. Raises ValueError for a network that cannot be
    lifted (see `refuse_hidden_state`).
    """

    def __init__(self, module: nn.Module):
        refuse_hidden_state(module)
        self.module = copy.deepcopy(module)
        self.places: list[Place] = []
        first_name: dict[Tensor, str] = {}  # a tensor in two places is one parameter
        for prefix, layer in self.module.named_modules():
            for own in (layer._parameters, layer._buffers):
                # A layer without a bias has None in its place.
                for attribute in [key for key, tensor in own.items() if tensor is not None]:
                    name = f"{prefix}.{attribute}" if prefix else attribute
                    tensor = own.pop(attribute)
                    assert tensor is not None
                    self.places.append(Place(first_name.setdefault(tensor, name), vars(layer), attribute))

    def lend(self, tensors: Tensors) -> nn.Module:
        """Returns the network, which computes with these tensors, by name, until others are lent."""
        for name, attributes, attribute in self.places:
            attributes[attribute] = tensors[name]
        return self.module


def refuse_hidden_state(module: nn.Module) -> None:
    """Raises ValueError for layers that draw random numbers or change their buffers when they are called."""
    for name, layer in module.named_modules():
        where = f"layer {name or 'itself'!r} ({type(layer).__name__}) of {type(module).__name__}"
        drops = isinstance(layer, nn.modules.dropout._DropoutNd) and layer.p > 0
        if drops or (isinstance(layer, nn.MultiheadAttention | nn.RNNBase) and layer.dropout > 0):
            raise ValueError(
                f"{where} draws a dropout mask by itself: draw it in `draw`, and multiply by it in `losses`"
            )
        if isinstance(layer, nn.modules.batchnorm._NormBase) and layer.track_running_stats:
            raise ValueError(f"{where} changes its buffers at every call: use LayerNorm")


def stacked(modules: list[nn.Module], kind: str) -> Tensors:
    """Returns the tensors of one network in S runs by name, each (S, ...). `kind` is one of `KINDS`."""
    runs = [dict(getattr(module, f"named_{kind}")()) for module in modules]
    return {name: torch.stack([run[name].detach() for run in runs]) for name in runs[0]}


def over_runs(function: Callable, runs: int) -> Callable:
    """Returns `function`, which is written for one run, for S runs.

    Its arguments and results get a first axis of length S. They are dicts or tuples of tensors, which may be
    nested. A single run is computed without vmap, because vmap takes extra time.
    """
    if runs > 1:
        return vmap(function)

    def alone(*arguments):
        # squeeze(0), not x[0]: the backward pass of indexing copies its gradient.
        result = function(*(map_tensors(argument, lambda x: x.squeeze(0)) for argument in arguments))
        return map_tensors(result, lambda x: x.unsqueeze(0))

    return alone


def map_tensors(tree: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """Returns the same nested dicts and tuples, with `function` applied to every tensor."""
    if isinstance(tree, dict):
        return {key: map_tensors(value, function) for key, value in tree.items()}
    if isinstance(tree, tuple):
        return tuple(map_tensors(value, function) for value in tree)
    return function(tree)


def clip_gradients(parameters: Iterable[Tensor], largest: float) -> None:
    """Scales one network's gradients, each (S, ...), so that no run's norm is larger than `largest`."""
    gradients = [p.grad for p in parameters if p.grad is not None]
    squares = [g.flatten(1).square().sum(1) if g.ndim > 1 else g.square() for g in gradients]
    norm = torch.stack(squares).sum(0).sqrt()  # (S,)
    factor = (largest / (norm + 1e-6)).clamp(max=1.0)
    for g in gradients:
        g.mul_(factor.view(-1, *[1] * (g.ndim - 1)))


def flat_names(tensors: dict[str, Tensors], prefix: str) -> Iterator[tuple[str, Tensor]]:
    """Yields every tensor of several networks with the name that files use, `prefix.network.name`."""
    for network, of_network in tensors.items():
        for name, tensor in of_network.items():
            yield f"{prefix}.{network}.{name}", tensor
