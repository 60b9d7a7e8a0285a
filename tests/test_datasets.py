"""Datasets in memory against oracles that share no code with them: slow loops and hashes by hand."""

import hashlib

import numpy as np
import pytest
import torch
from five_episodes import LENGTHS, SHORT_TASKS, assert_same, episodes_by_loop, h5_file, make_arrays

from tutorial_lib.data.dataset import KEYS, Dataset, DatasetError, sample_batch
from tutorial_lib.data.hdf5 import read_dataset, write_dataset


@pytest.fixture
def arrays():
    return make_arrays()


@pytest.fixture
def dataset(arrays):
    return Dataset(**arrays, attributes={"seed": 3})


def test_episodes_agree_with_a_slow_loop(dataset, arrays):
    episodes = episodes_by_loop(arrays)
    assert [len(rows) for rows in episodes] == list(LENGTHS)  # the oracle itself
    assert len(dataset) == sum(LENGTHS) and dataset.num_episodes == len(episodes)
    assert list(dataset.starts) == [rows[0] for rows in episodes]
    assert list(dataset.ends) == [rows[-1] + 1 for rows in episodes]
    assert list(dataset.episode_lengths) == list(LENGTHS)
    returns = [sum(float(arrays["rewards"][row]) for row in rows) for rows in episodes]
    costs = [sum(float(arrays["costs"][row]) for row in rows) for rows in episodes]
    np.testing.assert_allclose(dataset.episode_returns, returns, rtol=1e-12)
    np.testing.assert_allclose(dataset.episode_costs, costs, rtol=1e-12)
    assert [list(np.flatnonzero(dataset.episode_index == i)) for i in range(5)] == episodes


def test_sums_do_not_lose_what_float32_loses():
    """2**24 + 1 is not a float32: sums of many steps need float64."""
    rewards = np.array([2**24, 1], np.float32)
    column = np.zeros((2, 1), np.float32)
    data = Dataset(column, column, column, rewards, rewards, np.zeros(2, bool), np.array([False, True]))
    assert data.episode_returns.tolist() == data.episode_costs.tolist() == [2**24 + 1]


@pytest.mark.parametrize("wanted", [[3, 0], [-1], np.array([False, True, True, False, False])])
def test_select_keeps_whole_episodes_in_the_order_given(dataset, arrays, wanted):
    episodes = episodes_by_loop(arrays)
    indices = [i for i in range(5) if wanted[i]] if isinstance(wanted, np.ndarray) else wanted
    chosen = dataset.select(wanted)
    assert_same(chosen, arrays, rows=[row for i in indices for row in episodes[i]])
    assert chosen.num_episodes == len(indices) and chosen.attributes == {"seed": 3}


def test_select_of_nothing_is_an_error(dataset):
    with pytest.raises(DatasetError, match="none of 5 episodes"):
        dataset.select(dataset.episode_costs > 1e9)


def test_a_dataset_ends_with_an_episode(arrays):
    with pytest.raises(DatasetError, match="whole episodes"):
        Dataset(**{key: values[:-1] for key, values in arrays.items()})
    with pytest.raises(DatasetError, match="whole episodes"):
        Dataset(**{key: values[:0] for key, values in arrays.items()})


def test_tensors_hold_the_arrays_and_are_a_copy(dataset, arrays):
    before = {key: values.copy() for key, values in arrays.items()}
    batch = dataset.tensors()
    assert set(batch._fields) == {*arrays, "timesteps", "returns_to_go", "costs_to_go"}
    for key in arrays:
        tensor = getattr(batch, key)
        assert tensor.dtype == torch.float32 and tensor.shape == arrays[key].shape
        np.testing.assert_array_equal(tensor.numpy(), arrays[key].astype(np.float32))
        tensor.fill_(-9)
    assert_same(dataset, before)


def test_tensors_say_where_in_its_episode_a_transition_stands(dataset):
    batch, row = dataset.tensors(), 0
    for start, end in zip(dataset.starts, dataset.ends, strict=True):
        for t in range(end - start):
            assert batch.timesteps[row] == t
            assert batch.costs_to_go[row] == sum(dataset.costs[row:end].tolist())
            assert batch.returns_to_go[row] == pytest.approx(sum(dataset.rewards[row:end].tolist()), rel=1e-6)
            row += 1
    assert row == len(dataset)


def test_sampled_rows_belong_together_and_are_uniform(dataset):
    data = dataset.tensors()._replace(rewards=torch.arange(20.0))  # a reward now names its row
    batch = sample_batch(data, 20_000, torch.Generator().manual_seed(0))
    rows = batch.rewards.long()
    for values, all_values in zip(batch, data, strict=True):
        assert torch.equal(values, all_values[rows])
    counts = torch.bincount(rows, minlength=20)
    assert counts.min() > 850 and counts.max() < 1150  # 1000 expected, standard deviation 31


def test_sampling_depends_on_the_generator_alone(dataset):
    data = dataset.tensors()
    draw = lambda seed: sample_batch(data, 8, torch.Generator().manual_seed(seed))  # noqa: E731
    torch.manual_seed(1)
    first = draw(0)
    torch.manual_seed(2)
    assert torch.equal(first.observations, draw(0).observations)
    assert not torch.equal(first.observations, draw(1).observations)


def test_a_checksum_is_of_the_values_and_not_of_the_file(arrays, tmp_path):
    digest = hashlib.sha256()
    for key in KEYS:
        digest.update(arrays[key].tobytes())
    task = SHORT_TASKS["CarRun"]
    plain = h5_file(tmp_path / "plain.hdf5", arrays)
    packed = write_dataset(tmp_path / "packed.hdf5", Dataset(**arrays), task, {"seed": 4})
    assert plain.read_bytes() != packed.read_bytes()
    assert read_dataset(plain, task).checksum == read_dataset(packed, task).checksum
    assert read_dataset(plain, task).checksum == digest.hexdigest()
    for key in KEYS:
        changed = arrays | {key: arrays[key].copy()}
        changed[key][0] = 1 - changed[key][0] if changed[key].dtype != bool else ~changed[key][0]
        assert Dataset(**changed).checksum != digest.hexdigest(), key
