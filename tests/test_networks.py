"""The networks against plain layers with the same weights, and densities against torch.distributions."""

import math

import numpy as np
import pytest
import torch
from layers import relu_mlp, rounded_mlp
from torch import nn

from tutorial_lib.config import Config
from tutorial_lib.networks import (
    Critics,
    EnsembleLinear,
    Output,
    Policy,
    Value,
    gaussian_log_prob,
    mlp,
)

CONFIG = Config(hidden_width=16, hidden_layers=2)
B, OBS, ACT = 5, 7, 2
SCALES = (2.0, 30.0, 400.0)


@pytest.fixture(autouse=True)
def seeded():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def numbers(module):
    return sum(p.numel() for p in module.parameters())


@pytest.mark.parametrize(("layers", "expected"), [(0, 6 + 2), (1, 24 + 8 + 16 + 2), (5, 32 + 4 * 72 + 18)])
def test_mlp_has_as_many_hidden_layers_as_it_is_asked_for(layers, expected):
    net = mlp(3, 8, layers, 2)
    assert numbers(net) == expected
    assert [type(m) for m in net] == [nn.Linear, nn.ReLU] * layers + [Output]


def test_the_papers_networks_have_two_layers_of_256():
    assert numbers(Value(OBS, Config(), 1.0)) == (OBS * 256 + 256) + (256 * 256 + 256) + (256 + 1)


@pytest.mark.parametrize("batch", [1, B])
def test_values_are_one_number_per_state_and_heads_an_axis_more(batch):
    s, a = torch.randn(batch, OBS), torch.randn(batch, ACT)
    assert Value(OBS, CONFIG, 3.0)(s).shape == (batch,)
    assert Value(OBS, CONFIG, SCALES)(s).shape == (batch, 3)
    assert Value(OBS, CONFIG, (3.0,))(s).shape == (batch, 1)  # one head is not the same as none
    assert Critics(OBS, ACT, CONFIG, 3.0)(s, a).shape == (2, batch)
    assert Critics(OBS, ACT, CONFIG, SCALES, k=4)(s, a).shape == (4, batch, 3)
    assert Critics(OBS, ACT, CONFIG, (3.0,), k=1)(s, a).shape == (1, batch, 1)
    mean, log_std = Policy(OBS, ACT, CONFIG)(s)
    assert mean.shape == (batch, ACT) and log_std.shape == (ACT,)


@pytest.mark.parametrize("scale", [250.0, SCALES])
def test_a_value_is_its_scale_times_one_plus_its_layers(scale):
    value, s = Value(OBS, CONFIG, scale), torch.randn(B, OBS)
    linear = [m for m in value.net if isinstance(m, nn.Linear)]
    plain = relu_mlp(s, [m.weight for m in linear], [m.bias for m in linear])
    expected = 250 * (1 + plain[:, 0]) if scale == 250.0 else torch.tensor(SCALES) * (1 + plain)
    torch.testing.assert_close(value(s), expected)


@pytest.mark.parametrize("scale", [250.0, SCALES])
def test_the_ensemble_equals_separate_networks_with_the_same_weights(scale):
    critics, s, a = Critics(OBS, ACT, CONFIG, scale, k=3), torch.randn(B, OBS), torch.randn(B, ACT)
    together = critics(s, a)
    for k in range(3):
        layers = []
        for layer in critics.layers:
            linear = nn.Linear(*layer.weight.shape[1:])
            linear.load_state_dict({"weight": layer.weight[k].T, "bias": layer.bias[k, 0]})
            layers += [linear, nn.ReLU()]
        alone = nn.Sequential(*layers[:-1])(torch.cat([s, a], 1))
        expected = 250 * (1 + alone[:, 0]) if scale == 250.0 else torch.tensor(SCALES) * (1 + alone)
        torch.testing.assert_close(together[k], expected)


def test_a_critic_learns_without_the_others():
    critics = Critics(OBS, ACT, CONFIG, 1.0, k=3)
    critics(torch.randn(B, OBS), torch.randn(B, ACT))[1].sum().backward()
    for p in critics.parameters():
        assert p.grad[1].any() and not p.grad[0].any() and not p.grad[2].any()


def test_the_ensemble_starts_like_nn_linear():
    """Uniform within 1 / sqrt(inputs): the standard deviation is that over sqrt(3)."""
    ours, theirs = EnsembleLinear(4, 50, 400), nn.Linear(50, 1600)
    for mine, other in ((ours.weight, theirs.weight), (ours.bias, theirs.bias)):
        assert mine.abs().max() <= 1 / math.sqrt(50)
        assert mine.std().item() == pytest.approx(other.std().item(), rel=0.05)
        assert mine.std().item() == pytest.approx(1 / math.sqrt(150), rel=0.05)
        assert abs(mine.mean().item()) < 0.01
        assert not (mine[0] == mine[1]).any()  # every member starts from numbers of its own


def test_mean_actions_lie_within_the_box_and_follow_the_state():
    policy, s = Policy(OBS, ACT, CONFIG), torch.randn(B, OBS)
    linear = [m for m in policy.net if isinstance(m, nn.Linear)]
    plain = relu_mlp(s, [m.weight for m in linear], [m.bias for m in linear])
    torch.testing.assert_close(policy(s)[0], torch.tanh(plain))
    assert policy(1e4 * s)[0].abs().max() <= 1
    assert policy(s)[0].std(0).min() > 0


def test_the_log_std_is_learned_within_its_bounds():
    policy = Policy(OBS, ACT, CONFIG)
    mean, log_std = policy(torch.randn(B, OBS))
    gaussian_log_prob(torch.zeros(B, ACT), mean, log_std).sum().backward()
    assert policy.log_std.grad.all()
    with torch.no_grad():
        policy.log_std.copy_(torch.tensor([-9.0, 9.0]))
    assert policy(torch.randn(B, OBS))[1].tolist() == [-5.0, 2.0]


def test_log_prob_is_torch_distributions_own():
    actions, mean, log_std = torch.randn(B, ACT), torch.randn(B, ACT), torch.tensor([-1.5, 0.7])
    mean.requires_grad_(), log_std.requires_grad_()
    normal = torch.distributions.Independent(torch.distributions.Normal(mean, log_std.exp()), 1)
    ours, theirs = gaussian_log_prob(actions, mean, log_std), normal.log_prob(actions)
    assert ours.shape == (B,)
    torch.testing.assert_close(ours, theirs)
    weights = torch.arange(1.0, B + 1)
    for mine, other in zip(
        torch.autograd.grad((weights * ours).sum(), [mean, log_std]),
        torch.autograd.grad((weights * theirs).sum(), [mean, log_std]),
        strict=True,
    ):
        torch.testing.assert_close(mine, other)


def test_log_prob_by_hand():
    two_standard_normals_at_their_means = gaussian_log_prob(
        torch.zeros(1, 2), torch.zeros(1, 2), torch.zeros(2)
    )
    assert two_standard_normals_at_their_means.item() == pytest.approx(-math.log(2 * math.pi))


def test_a_seed_names_a_network():
    def build(seed):
        torch.manual_seed(seed)
        return Critics(OBS, ACT, CONFIG, 1.0).state_dict()

    first, again, other = build(1), build(1), build(2)
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert not any(torch.equal(first[key], other[key]) for key in first)


# --- bfloat16 ---


def test_under_autocast_hidden_layers_round_and_outputs_do_not():
    config = Config(hidden_width=64, hidden_layers=2)
    s, a = torch.randn(200, OBS), torch.randn(200, ACT)
    policy, critics = Policy(OBS, ACT, config), Critics(OBS, ACT, config, 1.0)
    doubles = [p.detach().double() for p in policy.net.parameters()]
    cases = [(lambda: policy.net(s), s, doubles[::2], doubles[1::2])]
    doubles = [p.detach().double() for p in critics.parameters()]
    pairs = torch.cat([s, a], 1)
    for k in range(2):
        one = [w[k].T for w in doubles[::2]], [b[k] for b in doubles[1::2]]
        cases.append((lambda k=k: critics(s, a)[k, :, None] - 1, pairs, *one))
    for network, inputs, weights, biases in cases:
        x = inputs.double()
        by_hand, exact = (f(x, weights, biases).numpy() for f in (rounded_mlp, relu_mlp))
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            found = network()
        assert found.dtype == torch.float32
        size = np.abs(by_hand - exact).mean()
        assert size > 1e-4  # there is something to see
        assert np.abs(found.numpy() - by_hand).mean() < 0.2 * size  # where sums lie between two numbers
        with torch.no_grad():
            np.testing.assert_allclose(network().numpy(), exact, atol=1e-5)


def test_a_network_without_hidden_layers_does_not_round():
    net, x = mlp(OBS, 0, 0, 3), torch.randn(200, OBS)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        found = net(x)
    assert torch.equal(found, net(x))
