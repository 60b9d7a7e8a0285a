"""The lift: lent networks and functions of one run, for several runs, against plain modules and loops."""

import copy

import numpy as np
import pytest
import torch
from layers import relu_mlp, to_bfloat16
from torch import nn
from torch.func import stack_module_state, vmap

from tutorial_lib.agents.lift import (
    Borrower,
    clip_gradients,
    map_tensors,
    over_runs,
    refuse_hidden_state,
    stacked,
)
from tutorial_lib.config import Config
from tutorial_lib.networks import Critics, Policy

CONFIG = Config(hidden_width=16, hidden_layers=2)
B, OBS, ACT = 5, 7, 2
SCALES = (2.0, 30.0, 400.0)


@pytest.fixture(autouse=True)
def seeded():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


# --- Lent tensors ---


class Everything(nn.Module):
    """Layers of many kinds: a buffer, an embedding, no bias, normalisation, attention, a tied parameter."""

    def __init__(self):
        super().__init__()
        self.register_buffer("shift", torch.randn(8))
        self.register_buffer("passing", torch.randn(8), persistent=False)
        self.scale = nn.Parameter(torch.randn(()))
        self.rows = nn.Embedding(4, 8)
        self.first = nn.Linear(OBS, 8, bias=False)
        self.norm = nn.LayerNorm(8)
        self.attention = nn.MultiheadAttention(8, 2, batch_first=True)
        self.second = nn.Linear(8, 8)
        self.third = nn.Linear(8, 8)
        self.third.weight = self.second.weight  # one parameter in two places
        self.again = self.norm  # one layer in two places
        self.none = nn.ModuleList([nn.Identity(), nn.Dropout(0.0)])

    def forward(self, x, kinds):
        tokens = (self.first(x) * self.scale)[:, None] + self.rows(kinds) + self.shift  # (B, 3, 8)
        mixed, _ = self.attention(tokens, tokens, tokens)
        mixed = self.again(self.norm(tokens + mixed) + self.passing)
        return self.third(torch.relu(self.second(self.none[1](self.none[0](mixed))))).mean(1)


def lent(nets):
    """The stacked tensors of these networks, parameters and buffers, as a borrower is lent them."""
    return stacked(nets, "parameters"), stacked(nets, "buffers")


@pytest.mark.parametrize("runs", [1, 2])
def test_all_kinds_of_layers_compute_with_what_they_are_lent(runs):
    """Values, and the gradient of every parameter, are those of the networks by themselves."""
    nets = [Everything() for _ in range(runs)]
    x, kinds = torch.randn(runs, B, OBS), torch.randint(4, (runs, B, 3))
    parameters, buffers = lent(nets)
    parameters = {name: value.requires_grad_() for name, value in parameters.items()}
    borrower = Borrower(Everything())  # its own numbers must not matter
    found = vmap(lambda p, b, *x: borrower.lend(p | b)(*x))(parameters, buffers, x, kinds)
    expected = torch.stack([net(*inputs) for net, *inputs in zip(nets, x, kinds, strict=True)])
    torch.testing.assert_close(found, expected)
    found.square().sum().backward()
    expected.square().sum().backward()
    for name, value in parameters.items():
        own = [dict(net.named_parameters())[name].grad for net in nets]
        torch.testing.assert_close(value.grad, torch.stack(own), rtol=1e-4, atol=1e-6, msg=name)
        assert value.grad.abs().max() > 0 or name == "attention.in_proj_bias", name


def test_every_tensor_has_one_name_and_none_is_lost():
    net = Everything()
    parameters, buffers = lent([net, Everything()])
    assert parameters.keys() == dict(net.named_parameters()).keys() and "third.weight" not in parameters
    assert buffers.keys() == {"shift", "passing"}
    assert "first.bias" not in parameters and "second.bias" in parameters
    for name, value in (parameters | buffers).items():
        own = dict(net.named_parameters()) | dict(net.named_buffers())
        assert torch.equal(value[0], own[name]) and not value.requires_grad


def test_a_tied_parameter_stays_one():
    """A change of it shows in both places, and its gradient is the sum over both."""
    net = Everything()
    parameters, buffers = (map_tensors(part, lambda x: x[0]) for part in lent([net]))
    module = Borrower(net).lend(parameters | buffers)
    assert module.third.weight is module.second.weight is parameters["second.weight"]


def test_the_network_that_was_given_keeps_its_tensors():
    net = Everything()
    before = {key: value.clone() for key, value in net.state_dict().items()}
    parameters, buffers = (map_tensors(part, lambda x: x[0] + 1) for part in lent([net]))
    borrower = Borrower(net)
    assert not list(borrower.module.parameters()) and not list(borrower.module.buffers())
    borrower.lend(parameters | buffers)
    assert net.state_dict().keys() == before.keys()
    assert all(torch.equal(value, before[key]) for key, value in net.state_dict().items())


@pytest.mark.parametrize("runs", [1, 3])
def test_a_borrower_computes_with_what_it_is_lent(runs):
    """As the networks of the library do, gradients too, for one set of parameters or for several at once."""
    s, a = torch.randn(runs, B, OBS), torch.randn(runs, B, ACT)
    nets = [Critics(OBS, ACT, CONFIG, SCALES) for _ in range(runs)]
    parameters, _ = stack_module_state(nets)
    borrower = Borrower(nets[0])
    found = vmap(lambda p, *x: borrower.lend(p)(*x))(parameters, s, a)
    expected = torch.stack([net(*x) for net, *x in zip(nets, s, a, strict=True)])
    torch.testing.assert_close(found, expected)
    weight = parameters["layers.0.weight"]
    (gradient,) = torch.autograd.grad(found.square().sum(), weight)
    own = [net.layers[0].weight for net in nets]
    torch.testing.assert_close(gradient, torch.stack(torch.autograd.grad(expected.square().sum(), own)))
    plain = {key: value[-1] for key, value in parameters.items()}
    torch.testing.assert_close(borrower.lend(plain)(s[0], a[0]), nets[-1](s[0], a[0]))
    assert not list(borrower.module.parameters()) and len(list(nets[0].parameters())) == len(plain)


def test_under_autocast_the_lift_adds_biases_in_float32():
    config = Config(hidden_width=64, hidden_layers=1)
    nets, s = [Policy(OBS, ACT, config) for _ in range(2)], torch.randn(200, OBS)
    parameters, _ = stack_module_state(nets)
    borrower = Borrower(nets[0])
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        found = vmap(lambda p: borrower.lend(p).net(s))(parameters)
    for net, actual in zip(nets, found, strict=True):
        w1, b1, w2, b2 = (p.detach().double() for p in net.net.parameters())
        products = to_bfloat16(to_bfloat16(s) @ to_bfloat16(w1).T)
        by_hand = ((products + b1).clamp(min=0) @ w2.T + b2).numpy()
        np.testing.assert_allclose(actual.numpy(), by_hand, atol=2e-3)
        exact = relu_mlp(s.double(), (w1, w2), (b1, b2)).numpy()
        assert np.abs(actual.numpy() - by_hand).mean() < 0.1 * np.abs(actual.numpy() - exact).mean()


# --- Layers that cannot be lifted ---


@pytest.mark.parametrize(
    ("layer", "words"),
    [
        (
            nn.Dropout(0.1),
            r"layer '1' \(Dropout\) of Sequential draws a dropout mask by itself: draw it in `draw`",
        ),
        (nn.AlphaDropout(0.1), r"'1' \(AlphaDropout\) .*multiply by it in `losses`"),
        (nn.MultiheadAttention(4, 2, dropout=0.1), r"'1' \(MultiheadAttention\) .*draws a dropout mask"),
        (nn.TransformerEncoderLayer(4, 2, 8), r"'1.*\(\w+\) of Sequential draws a dropout mask"),
        (nn.BatchNorm1d(4), r"'1' \(BatchNorm1d\) .*changes its buffers at every call: use LayerNorm"),
        (nn.InstanceNorm1d(4, track_running_stats=True), r"'1' \(InstanceNorm1d\) .*use LayerNorm"),
    ],
    ids=lambda part: type(part).__name__,
)
def test_a_layer_with_hidden_state_is_refused_by_its_name(layer, words):
    net = nn.Sequential(nn.Linear(4, 4), layer)
    for refuse in (refuse_hidden_state, Borrower):
        with pytest.raises(ValueError, match=words) as error:
            refuse(net)
        assert "\n" not in str(error.value)


def test_a_network_that_is_such_a_layer_itself_is_refused_too():
    with pytest.raises(ValueError, match=r"layer 'itself' \(Dropout\)"):
        Borrower(nn.Dropout(0.5))


@pytest.mark.parametrize(
    "layer",
    [
        nn.Dropout(0.0),
        nn.BatchNorm1d(4, track_running_stats=False),
        nn.InstanceNorm1d(4),
        nn.LayerNorm(4),
        nn.GroupNorm(2, 4),
        nn.MultiheadAttention(4, 2),
        nn.TransformerEncoderLayer(4, 2, 8, dropout=0.0),
    ],
    ids=lambda layer: type(layer).__name__,
)
def test_layers_that_only_compute_are_taken(layer):
    Borrower(nn.Sequential(nn.Linear(4, 4), layer))


# --- Functions of one run ---


def nested(own, x):
    """A function of one run: nested dicts in, nested dicts and a tuple out."""
    y = own["net"]["weight"] @ x["in"] + own["shift"]
    return {"y": y, "parts": {"sum": y.sum()}}, (y.square().mean(), own["shift"])


@pytest.mark.parametrize("runs", [1, 2, 5])
def test_a_lifted_function_is_a_loop_over_runs(runs):
    own = {"net": {"weight": torch.randn(runs, 3, 4)}, "shift": torch.randn(runs, 3)}
    x = {"in": torch.randn(runs, 4)}
    found = over_runs(nested, runs)(own, x)
    for run in range(runs):
        alone = nested(
            {"net": {"weight": own["net"]["weight"][run]}, "shift": own["shift"][run]}, {"in": x["in"][run]}
        )
        torch.testing.assert_close(found[0]["y"][run], alone[0]["y"])
        torch.testing.assert_close(found[0]["parts"]["sum"][run], alone[0]["parts"]["sum"])
        torch.testing.assert_close(found[1][0][run], alone[1][0])
        torch.testing.assert_close(found[1][1][run], alone[1][1])
    assert found[0]["parts"]["sum"].shape == found[1][0].shape == (runs,)


@pytest.mark.parametrize("runs", [1, 3])
def test_the_gradient_of_the_sum_gives_each_run_its_own(runs):
    weight, x = torch.randn(runs, 4, requires_grad=True), torch.randn(runs, 4)
    over_runs(lambda w, x: (w * x).sum().square(), runs)(weight, x).sum().backward()
    for run in range(runs):
        expected = 2 * (weight[run] @ x[run]).item() * x[run]
        torch.testing.assert_close(weight.grad[run], expected)


# --- Clipping ---


@pytest.mark.parametrize("largest", [0.5, 2.0, 1e6])
def test_gradients_are_clipped_by_each_runs_own_norm(largest):
    runs = 3
    shapes = [(4, 3), (4,), ()]
    parameters = [torch.zeros(runs, *shape, requires_grad=True) for shape in shapes]
    sizes = [0.01, 1.0, 100.0]  # one run far below the bound, one far above
    for p in parameters:
        p.grad = torch.stack([size * torch.randn(p.shape[1:]) for size in sizes])
    unused = torch.zeros(runs, 2, requires_grad=True)  # no loss reached it
    before = copy.deepcopy([p.grad for p in parameters])
    clip_gradients([*parameters, unused], largest)
    assert unused.grad is None
    for run in range(runs):
        norm = sum(g[run].square().sum().item() for g in before) ** 0.5
        factor = min(1.0, largest / norm)
        for p, g in zip(parameters, before, strict=True):
            torch.testing.assert_close(p.grad[run], factor * g[run], rtol=1e-4, atol=1e-7)
