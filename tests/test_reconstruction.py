"""The reconstruction model against loops, numpy.linalg.lstsq and what one discounted sum can tell.

Most tests use a task of 20 steps with small discount factors, which is learned in a second.
"""

import dataclasses

import numpy as np
import pytest
import torch

from tutorial_lib.costs import reconstruction
from tutorial_lib.costs.reconstruction import (
    CostReconstruction,
    ReconstructionConfig,
    episode_sums,
    random_sums,
    reconstruction_error,
    train_reconstruction,
)
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.tasks import TASKS

T, GAMMAS = 20, (0.8, 0.85, 0.9)
TASK = dataclasses.replace(TASKS["BallRun"], horizon=T, gammas=GAMMAS)
SMALL = ReconstructionConfig(crm_width=32, crm_layers=2, crm_steps=1500, batch_size=128)
LINEAR = dataclasses.replace(SMALL, crm="linear")


def dataset_of(episodes, fallen=()):
    """A dataset of episodes with these costs; those in `fallen` end in a terminal, others in a timeout."""
    costs = np.concatenate(episodes).astype(np.float32)
    last = np.cumsum([len(costs) for costs in episodes]) - 1
    terminals, timeouts = np.zeros((2, len(costs)), bool)
    timeouts[last] = True
    timeouts[last[list(fallen)]] = False
    terminals[last[list(fallen)]] = True
    zeros = np.zeros((len(costs), 7), np.float32)
    return Dataset(zeros, zeros, zeros[:, :2], zeros[:, 0], costs, terminals, timeouts)


def slow_sums(costs, gammas=GAMMAS):
    return [sum(gamma**t * c for t, c in enumerate(costs)) for gamma in gammas], sum(costs)


def fresh_sequences(n, seed=7):
    """Costs at a random rate within a random window: neither the dataset's nor the module's own generator."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        start, end = np.sort(rng.integers(0, T + 1, 2))
        rate = rng.random()
        yield [float(start <= t < end and rng.random() < rate) for t in range(T)]


@pytest.fixture(scope="module")
def dataset():
    return dataset_of([np.array(c) for c in fresh_sequences(100, seed=1)])


@pytest.fixture(scope="module")
def fresh():
    x, y = zip(*map(slow_sums, fresh_sequences(2000)), strict=True)
    return torch.tensor(x, dtype=torch.float32), torch.tensor(y, dtype=torch.float32)


@pytest.fixture(scope="module")
def trained(dataset):
    return train_reconstruction(TASK, SMALL, dataset, seed=3, progress=False)


def mse(prediction, y):
    return (prediction - y).square().mean().item()


# --- The data ---


def test_episode_sums_are_their_loops_also_where_an_episode_was_cut_short():
    rng = np.random.default_rng(0)
    episodes = [rng.choice([0, 1, 2.5], size) for size in (T, 1, 7, T, T - 1)]
    x, y = episode_sums(dataset_of(episodes, fallen=(1, 2, 4)), TASK)
    assert x.shape == (5, 3) and y.shape == (5,)
    for row, total, costs in zip(x, y, episodes, strict=True):
        expected, sum_ = slow_sums(costs)
        np.testing.assert_allclose(row, expected, rtol=1e-6)
        assert total == pytest.approx(sum_)


@pytest.mark.parametrize("n", [1, 30, 100])
def test_random_sums_are_sums_that_sequences_of_zeros_and_ones_can_have(n):
    x, y = random_sums(TASK, n, np.random.default_rng(0))
    assert x.shape == (n, 3) and y.shape == (n,)
    for row, total in zip(x, y, strict=True):
        assert total == int(total) and 0 <= total <= T
        early, late = (slow_sums(c)[0] for c in ([1] * int(total), [0] * (T - int(total)) + [1] * int(total)))
        assert (np.array(late) - 1e-5 <= row).all() and (row <= np.array(early) + 1e-5).all()


def test_random_sums_are_a_third_of_each_kind_in_random_order(monkeypatch):
    """Each kind is replaced by sequences that tell it from the others."""
    marks = {"uniform": 1.0, "block": 2.0, "beta": 3.0}
    monkeypatch.setattr(
        reconstruction,
        "random_cost_sequences",
        lambda kind, n, horizon, rng: np.repeat(np.eye(1, horizon) * marks[kind], n, 0),
    )
    _, y = random_sums(TASK, 300, np.random.default_rng(0))
    assert [int((y == mark).sum()) for mark in marks.values()] == [100, 100, 100]
    assert all(60 < (y[:200] == mark).sum() < 74 for mark in marks.values())


# --- The network ---


def test_a_model_takes_any_batch_and_the_seeds_of_a_run_beside_it():
    model = CostReconstruction(TASK, SMALL)
    x = torch.rand(2, 5, 3)
    assert model(x).shape == (2, 5)
    torch.testing.assert_close(model(x)[1, 3], model(x[1, 3]))


def test_the_papers_model_has_five_hidden_layers_of_512():
    linear = [
        m for m in CostReconstruction(TASK, ReconstructionConfig()).net if isinstance(m, torch.nn.Linear)
    ]
    assert [(m.in_features, m.out_features) for m in linear] == [(3, 512)] + [(512, 512)] * 4 + [(512, 1)]


@pytest.mark.parametrize("config", [SMALL, LINEAR], ids=["mlp", "linear"])
def test_a_model_tells_fresh_costs_better_than_any_one_discounted_sum(config, trained, dataset, fresh):
    x, y = fresh
    model = trained if config is SMALL else train_reconstruction(TASK, LINEAR, dataset, progress=False)
    error = mse(model(x), y)
    assert error < 0.05 * y.var().item()
    for head, gamma in enumerate(GAMMAS):
        steady = sum(gamma**t for t in range(T)) / T
        slope, offset = np.polyfit(x[:, head], y, 1)  # the best line, fitted to these very sequences
        assert error < 0.5 * min(mse(x[:, head] / steady, y), mse(slope * x[:, head] + offset, y))


def test_the_network_learns_from_noisy_inputs(monkeypatch):
    """Sums of 0 and 1 on all inputs, costs of 0 and 10: seen through noise of deviation 1, inputs of x are
    e^(sum(x) - 3/2) times likelier to be the second, which makes the best answer a sigmoid."""
    constant = np.ones((500, 3)), np.full(500, 10.0)
    monkeypatch.setattr(reconstruction, "random_sums", lambda task, n, rng: constant)
    config = dataclasses.replace(SMALL, crm_noise=1.0, crm_steps=600)
    model = train_reconstruction(TASK, config, dataset_of([np.zeros(T)]), progress=False)
    for x in (-0.5, 0.0, 0.5, 1.0, 1.5):
        assert model(torch.full((3,), x)).item() == pytest.approx(10 / (1 + np.exp(1.5 - 3 * x)), abs=0.6)


@pytest.mark.parametrize("config", [dataclasses.replace(SMALL, crm_steps=400), LINEAR], ids=["mlp", "linear"])
def test_the_dataset_counts_as_much_as_the_random_sequences(config, monkeypatch):
    """Where the same sums have cost 0 in the one and 10 in the other, 5 is right, however many each has."""
    constant = np.zeros((500, 3)), np.full(500, 10.0)
    monkeypatch.setattr(reconstruction, "random_sums", lambda task, n, rng: constant)
    config = dataclasses.replace(config, crm_noise=0.1, batch_size=256)
    model = train_reconstruction(TASK, config, dataset_of([np.zeros(T)] * 6), progress=False)
    assert model(torch.zeros(3)).item() == pytest.approx(5, abs=0.7)


# --- The linear baseline, in closed form ---


@pytest.fixture
def few(monkeypatch):
    """Known training data: 40 episodes, and 90 random sequences in the place of many."""
    pool = list(zip(*map(slow_sums, fresh_sequences(90, seed=2)), strict=True))
    monkeypatch.setattr(reconstruction, "random_sums", lambda task, n, rng: tuple(map(np.array, pool)))
    episodes = list(fresh_sequences(40, seed=3))
    data = list(zip(*map(slow_sums, episodes), strict=True))
    x, y = np.concatenate([data[0], pool[0]]), np.concatenate([data[1], pool[1]])
    share = np.concatenate([np.full(40, 0.5 / 40), np.full(90, 0.5 / 90)])
    return dataset_of([np.array(c) for c in episodes]), x, y, share


def weights_of(model):
    """The linear model in plain units: its answer at zero, and its slope along every input."""
    zero = model(torch.zeros(3)).item()
    return np.array([model(row).item() - zero for row in torch.eye(3)] + [zero])


@pytest.mark.parametrize("config", [dataclasses.replace(SMALL, crm_steps=1), LINEAR], ids=["mlp", "linear"])
def test_the_network_sees_noisy_training_data_with_mean_zero_and_no_correlation(config, few):
    """Their mean and covariance by loops: every row with its share, and the noise's own covariance."""
    dataset, x, _, share = few
    model = train_reconstruction(TASK, dataclasses.replace(config, crm_noise=0.3), dataset, progress=False)
    seen = []
    model.net.register_forward_pre_hook(lambda net, inputs: seen.append(inputs[0]))
    model(torch.tensor(np.vstack([x, np.zeros(3), np.eye(3)]), dtype=torch.float32))
    rows, origin, axes = np.split(seen[0].double().numpy(), [len(x), len(x) + 1])
    noise = 0.3 * (axes - origin)  # how one standard deviation on each input arrives
    mean = sum(s * row for s, row in zip(share, rows, strict=True))
    covariance = sum(s * np.outer(row, row) for s, row in zip(share, rows, strict=True))
    covariance += sum(np.outer(step, step) for step in noise)
    np.testing.assert_allclose(mean, np.zeros(3), atol=1e-4)
    np.testing.assert_allclose(covariance, np.eye(3), atol=1e-3)


@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0])
def test_the_linear_baseline_is_ridge_regression(noise, few):
    """lstsq with a row for every transition and a row per weight that asks it to be zero."""
    dataset, x, y, share = few
    rows = np.sqrt(share)[:, None] * np.column_stack([x, np.ones(len(x))])
    penalty = noise * np.eye(3, 4)
    aims = np.concatenate([np.sqrt(share) * y, np.zeros(3)])
    expected = np.linalg.lstsq(np.vstack([rows, penalty]), aims)[0]
    model = train_reconstruction(TASK, dataclasses.replace(LINEAR, crm_noise=noise), dataset, progress=False)
    np.testing.assert_allclose(weights_of(model), expected, rtol=1e-3, atol=1e-3)


def test_the_ridge_stands_for_noise_on_the_inputs(few):
    """lstsq on 3000 noisy copies of the data."""
    dataset, x, y, share = few
    noisy = x + 0.3 * np.random.default_rng(0).normal(size=(3000, *x.shape))
    rows = np.sqrt(share)[:, None] * np.concatenate([noisy, np.ones((*noisy.shape[:2], 1))], 2)
    expected = np.linalg.lstsq(rows.reshape(-1, 4), np.tile(np.sqrt(share) * y, 3000))[0]
    model = train_reconstruction(TASK, dataclasses.replace(LINEAR, crm_noise=0.3), dataset, progress=False)
    np.testing.assert_allclose(weights_of(model), expected, rtol=0.01, atol=0.02)


# --- Seeds ---


def test_a_seed_names_a_model_and_global_random_state_is_neither_used_nor_touched(dataset):
    config = dataclasses.replace(SMALL, crm_steps=20)

    def train(seed, elsewhere):
        torch.manual_seed(elsewhere)
        np.random.seed(elsewhere)
        before = torch.get_rng_state(), np.random.get_state()[1].copy(), np.random.get_state()[2]
        model = train_reconstruction(TASK, config, dataset, seed=seed, progress=False)
        assert torch.equal(torch.get_rng_state(), before[0])
        assert (np.random.get_state()[1] == before[1]).all() and np.random.get_state()[2] == before[2]
        return torch.cat([p.flatten() for p in model.parameters()])

    first = train(1, elsewhere=0)
    assert torch.equal(first, train(1, elsewhere=99))
    assert not torch.equal(first, train(2, elsewhere=0))


def test_a_seed_names_the_first_weights_and_the_batches(few, monkeypatch):
    dataset, *_ = few  # with the same data for all seeds

    def train(seed, steps):
        config = dataclasses.replace(SMALL, crm_steps=steps)
        model = train_reconstruction(TASK, config, dataset, seed=seed, progress=False)
        return torch.cat([p.flatten() for p in model.parameters()])

    assert not torch.equal(train(0, steps=0), train(1, steps=0))
    same_start = torch.manual_seed
    monkeypatch.setattr(torch, "manual_seed", lambda seed: same_start(0))
    assert torch.equal(train(0, steps=0), train(1, steps=0))
    assert not torch.equal(train(0, steps=1), train(1, steps=1))


def test_a_trained_model_is_frozen(trained, dataset):
    linear = train_reconstruction(TASK, LINEAR, dataset, progress=False)
    assert not any(p.requires_grad for model in (trained, linear) for p in model.parameters())


@pytest.mark.parametrize("config", [SMALL, LINEAR], ids=["mlp", "linear"])
def test_a_model_loads_what_another_saved(config, dataset):
    config = dataclasses.replace(config, crm_steps=5)
    model, other = (train_reconstruction(TASK, config, dataset, seed=seed, progress=False) for seed in (0, 1))
    x = torch.rand(6, 3)
    other.load_state_dict(model.state_dict())
    assert torch.equal(model(x), other(x))


def test_the_error_of_a_model_that_always_says_the_same_by_hand(dataset):
    """A constant errs by the costs' distance from it; episodes and random sequences count for a half each."""
    model = CostReconstruction(TASK, LINEAR)
    for parameter in model.parameters():
        parameter.data.zero_()
    model.net.bias.data.fill_(0.25)  # of 20 steps: a cost of 5
    _, episodes = episode_sums(dataset, TASK)
    _, others = random_sums(TASK, 200_000, np.random.default_rng(9))
    expected = (np.mean((episodes - 5) ** 2) / 2 + np.mean((others - 5) ** 2) / 2) ** 0.5
    assert reconstruction_error(model, TASK, LINEAR, dataset) == pytest.approx(expected, rel=0.02)


def test_the_error_counts_the_noise_of_the_inputs(dataset):
    """With weights w, independent noise of standard deviation s adds s^2 |w|^2 to the mean square."""
    model = CostReconstruction(TASK, LINEAR)
    model.net.weight.data = torch.tensor([[3.0, -2.0, 1.0]]) / T  # the output is T times the network's
    model.net.bias.data.zero_()
    silent, noisy = (
        reconstruction_error(model, TASK, dataclasses.replace(LINEAR, crm_noise=noise), dataset)
        for noise in (0.0, 4.0)
    )
    assert noisy**2 - silent**2 == pytest.approx(16 * (9 + 4 + 1), rel=0.15)


@pytest.mark.parametrize("config", [SMALL, LINEAR], ids=["mlp", "linear"])
def test_under_autocast_only_hidden_layers_round(config, dataset):
    model = train_reconstruction(TASK, config, dataset, progress=False)
    x = torch.as_tensor(episode_sums(dataset, TASK)[0]).float()
    with torch.no_grad():
        whitened = (x - model.mean) @ model.whiten
        with torch.autocast("cpu", torch.bfloat16):
            found, expected = model(x), model.net(whitened).squeeze(-1) * model.horizon
        assert found.dtype == torch.float32 and torch.equal(found, expected)
        assert torch.equal(found, model(x)) == (config == LINEAR)
