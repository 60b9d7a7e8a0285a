"""Files of agents: written and read, damaged, of another run, without room; none is a pickle."""

import dataclasses
import json
import os
import zipfile

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from tiny import EVERY, make_agent, make_dataset, tensors_in

from tutorial_lib.agents import ALGORITHMS
from tutorial_lib.checkpoints import TrainingError, load_agent, save_agent
from tutorial_lib.training import train


@pytest.fixture(scope="module")
def dataset():
    return make_dataset()


# --- Agents ---


@pytest.mark.filterwarnings("ignore:.*of Q_r are negative")
@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_loaded_agent_acts_like_the_saved_one(name, dataset, tmp_path):
    agent = make_agent(name, seeds=(1, 2, 3), limits=(38.0, 40.0, 42.0))
    path = tmp_path / "deep" / "agent.safetensors"
    train(agent, dataset, updates=3, progress=False)
    save_agent(agent, path)
    loaded = load_agent(str(path))
    assert (loaded.task, loaded.name, loaded.config) == (agent.task, agent.name, agent.config)
    assert (loaded.seeds, loaded.limits, loaded.updates) == (agent.seeds, agent.limits, 3)
    assert loaded.limits == ((38.0, 40.0, 42.0) if agent.needs_limit else None)
    rng = np.random.default_rng(0)
    given = rng.normal(size=(20, 7)), rng.choice([0.0, 30.0, np.inf], size=20)
    for run in range(3):
        np.testing.assert_array_equal(loaded.act(*given, run), agent.act(*given, run))
        expected = agent.predicted_cost(*given, run)
        np.testing.assert_array_equal(loaded.predicted_cost(*given, run), expected)
    assert not np.array_equal(agent.act(*given, 0), agent.act(*given, 1))
    assert not any(key.startswith(("adam.", "target.")) for key in tensors_in(path))


def test_an_agent_remembers_its_data(dataset, tmp_path):
    agent, path = make_agent(), tmp_path / "agent.safetensors"
    save_agent(agent, path)
    assert load_agent(path).data_checksum is None
    train(agent, dataset, updates=1, progress=False)
    save_agent(agent, path)
    assert load_agent(path).data_checksum == dataset.checksum


def test_equal_agents_are_equal_files_and_other_agents_are_not(tmp_path):
    """The library writes metadata in a random order: of twelve files, two would differ almost surely."""
    agent = make_agent("C2IQL")
    for number in range(12):
        save_agent(agent, tmp_path / f"{number}.safetensors")
    save_agent(make_agent("C2IQL", seeds=(1,)), tmp_path / "other")
    files = {path.read_bytes() for path in tmp_path.glob("*.safetensors")}
    assert len(files) == 1 and (tmp_path / "other").read_bytes() not in files


@pytest.mark.skipif(not os.path.exists("/proc/self/maps"), reason="Linux lists there what is mapped")
def test_no_file_stays_mapped_after_a_resume(dataset, tmp_path):
    """Windows cannot replace a file that is mapped, and the next checkpoint replaces the last one."""
    train(make_agent(), dataset, updates=20, run_dir=tmp_path, **EVERY)
    agent = make_agent()
    train(agent, dataset, updates=40, run_dir=tmp_path, **EVERY)
    loaded = load_agent(tmp_path / "checkpoint.safetensors")
    with open("/proc/self/maps") as maps:
        assert str(tmp_path) not in maps.read() and agent.updates == loaded.updates == 40


def test_without_reconstruction_none_is_saved():
    assert not [name for name in make_agent("C2IQL w/o CR").state() if "reconstruction" in name]


def test_a_file_of_another_number_of_runs_is_refused():
    """Copied, one run would be repeated for all."""
    three, one = make_agent(seeds=(0, 1, 2)), make_agent()
    with pytest.raises(ValueError, match="shape"):
        three.load_state(one.state())


def test_no_file_of_a_run_is_a_pickle(dataset, tmp_path):
    """Whoever loads a stranger's agent must not run a stranger's code."""
    agent = make_agent("C2IQL")
    train(agent, dataset, run_dir=tmp_path, updates=2, progress=False)
    save_agent(agent, tmp_path / "agent.safetensors")
    names = {"agent.safetensors", "checkpoint.safetensors", "metrics.csv"}
    assert {path.name for path in tmp_path.iterdir()} == names
    for path in tmp_path.glob("*.safetensors"):
        data = path.read_bytes()
        assert not zipfile.is_zipfile(path) and data[:1] != b"\x80"
        size = int.from_bytes(data[:8], "little")  # safetensors: this, as much JSON, and plain numbers
        header = json.loads(data[8 : 8 + size])
        ends = [entry["data_offsets"][1] for key, entry in header.items() if key != "__metadata__"]
        assert len(data) == 8 + size + max(ends)
    lines = (tmp_path / "metrics.csv").read_text().splitlines()
    assert len(lines) == 2 and all(line.isprintable() for line in lines)


# --- What is no agent ---


@pytest.fixture(scope="module")
def agent_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("agent") / "agent.safetensors"
    save_agent(make_agent("C2IQL", seeds=(0, 1)), path)
    return path


def rewritten(source, path, header=None, drop="", cut="", config=None, **changed):
    """A copy with entries of the header or options changed, tensors left out, cut short, changed or added."""
    with safe_open(source, "pt") as file:
        metadata = file.metadata() | (header or {})
    if config:
        metadata["config"] = json.dumps(json.loads(metadata["config"]) | config)
    tensors = tensors_in(source)
    for key, value in list(tensors.items()):
        if cut and key.startswith(cut):
            tensors[key] = value[..., :-1].contiguous()
        if drop and key.startswith(drop):
            del tensors[key]
    for key, change in changed.items():
        tensors[key] = change(tensors.get(key)).contiguous()
    save_file(tensors, path, metadata={key: value for key, value in metadata.items() if value is not None})


DAMAGE = {
    "missing": lambda source, path: None,
    "empty": lambda source, path: path.write_bytes(b""),
    "half a file": lambda source, path: path.write_bytes(source.read_bytes()[: source.stat().st_size // 2]),
    "half a header": lambda source, path: path.write_bytes(source.read_bytes()[:20]),
    "random bytes": lambda source, path: path.write_bytes(np.random.default_rng(0).bytes(5_000)),
    "text": lambda source, path: path.write_text("seed,update\n1,2\n"),
    "a folder": lambda source, path: path.mkdir(),
    "somebody else's tensors": lambda source, path: save_file({"x": torch.zeros(3)}, path),
    "unknown algorithm": lambda source, path: rewritten(source, path, {"algorithm": "SAC"}),
    "unknown task": lambda source, path: rewritten(source, path, {"task": "Humanoid"}),
    "unknown option": lambda source, path: rewritten(source, path, {"config": json.dumps({"colour": 1})}),
    "an option out of its bounds": lambda source, path: rewritten(source, path, {"config": '{"gamma": 2.0}'}),
    "options that are no JSON": lambda source, path: rewritten(source, path, {"config": "{"}),
    "a limit that it does not take": lambda source, path: rewritten(source, path, {"limits": "[30, 30]"}),
    "no limits": lambda source, path: rewritten(source, path, {"limits": None}),
    "another number of seeds": lambda source, path: rewritten(source, path, {"seeds": "[0, 1, 2]"}),
    "no network": lambda source, path: rewritten(source, path, drop="online.policy"),
    "no variable": lambda source, path: rewritten(source, path, drop="variable.reward_scale"),
    "no reconstruction": lambda source, path: rewritten(source, path, drop="buffer.reconstruction."),
    "narrow network": lambda source, path: rewritten(source, path, cut="online.policy.net.0.weight"),
    "narrow variable": lambda source, path: rewritten(source, path, cut="variable.observation_mean"),
    "narrow reconstruction": lambda source, path: rewritten(source, path, cut="online.reconstruction.net"),
    "an option is missing": lambda source, path: rewritten(source, path, {"config": '{"profile": "paper"}'}),
    "an unknown entry": lambda source, path: rewritten(source, path, {"colour": "red"}),
    "an unknown tensor": lambda source, path: rewritten(source, path, colour=lambda x: torch.zeros(2)),
    "options that are a list": lambda source, path: rewritten(source, path, {"config": "[1]"}),
    "a nest of lists": lambda source, path: rewritten(source, path, {"config": "[" * 100_000}),
    "seeds that are text": lambda source, path: rewritten(source, path, {"seeds": '["0", "1"]'}),
    "a seed of 65 bits": lambda source, path: rewritten(source, path, {"seeds": f"[0, {2**64}]"}),
    "no whole numbers": lambda source, path: rewritten(source, path, {"seeds": "[0.5, 1]"}),
    "data that are a number": lambda source, path: rewritten(source, path, {"data": "7"}),
    "a pipe": lambda source, path: os.mkfifo(path),
    "float64": lambda source, path: rewritten(source, path, **{"variable.reward_scale": torch.Tensor.double}),
    "negative updates": lambda source, path: rewritten(source, path, updates=lambda x: x - 1),
    "many updates": lambda source, path: rewritten(source, path, updates=lambda x: x.repeat(2)),
    "a moment of another shape": lambda source, path: rewritten(
        source, path, **{"adam.0.exp_avg": lambda x: torch.zeros(1), "adam.0.step": lambda x: torch.zeros(())}
    ),
}
NOT_FINITE = {
    f"{value} in {name}": (name, value)
    for name in ("online.policy.net.0.weight", "variable.observation_std", "buffer.reconstruction.whiten")
    for value in (float("nan"), float("inf"), float("-inf"))
}
ABSURD = {
    "a million runs": {"header": {"seeds": json.dumps(list(range(1_000_000)))}},
    "a wide network": {"config": {"hidden_width": 10**9}},
    "a network of 10 million units": {"config": {"hidden_width": 10**7}},
    "a deep network": {"config": {"hidden_layers": 10**5}},
    "a deeper network": {"config": {"hidden_layers": 10**12}},
    "many critics": {"config": {"cost_critics": 10**6}},
    "a wide reconstruction": {"config": {"crm_width": 10**7}},
    "a deep reconstruction": {"config": {"crm_layers": 10**6}},
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_file_that_is_no_agent_is_one_line_of_error(damage, agent_file, tmp_path):
    path = tmp_path / "agent.safetensors"
    DAMAGE[damage](agent_file, path)
    with pytest.raises(TrainingError) as error:
        load_agent(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)


@pytest.mark.parametrize("where", NOT_FINITE)
def test_an_agent_with_a_number_that_is_not_finite_is_refused(where, agent_file, tmp_path):
    path, (name, value) = tmp_path / "agent.safetensors", NOT_FINITE[where]

    def poisoned(tensor):
        tensor.flatten()[-1] = value
        return tensor

    rewritten(agent_file, path, **{name: poisoned})
    with pytest.raises(TrainingError, match=f"{name} has values that are NaN or infinite"):
        load_agent(path)


@pytest.mark.parametrize("size", ABSURD)
def test_a_size_that_the_tensors_do_not_have_takes_no_memory(size, agent_file, tmp_path):
    resource = pytest.importorskip("resource", reason="measures memory")
    path = tmp_path / "agent.safetensors"
    rewritten(agent_file, path, **ABSURD[size])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(TrainingError) as error:
        load_agent(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000  # in KB on Linux
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_an_untouched_copy_is_an_agent(agent_file, tmp_path):
    """The damage above is the damage, not the copying."""
    rewritten(agent_file, tmp_path / "copy.safetensors")
    assert load_agent(tmp_path / "copy.safetensors").seeds == (0, 1)


def test_a_folder_is_no_agent(tmp_path):
    with pytest.raises(TrainingError, match="is a folder: name the agent.safetensors in it"):
        load_agent(tmp_path)


def test_a_write_for_which_there_is_no_room_leaves_the_old_file(dataset, tmp_path):
    resource = pytest.importorskip("resource", reason="limits the size of files")
    agent, path = make_agent(), tmp_path / "agent.safetensors"
    save_agent(agent, path)
    before = path.read_bytes()
    train(agent, dataset, updates=1, progress=False)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limits[1]))
        with pytest.raises(OSError, match=f"{path}"):
            save_agent(agent, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


# --- Checkpoints ---


@pytest.mark.parametrize(
    "other",
    [
        {"seeds": (0, 1)},
        {"name": "C2IQL w/o CC"},
        {"limits": 50.0},
        {"seeds": (0, 0), "limits": (40.0, 50.0)},
        {"task": "CarRun"},
        {"kappa_1": 0.6},
        {"updates": 70},
    ],
    ids=str,
)
def test_a_checkpoint_of_another_run_is_refused(other, dataset, tmp_path):
    mine = {"name": "CIQL", "seeds": (0,)}
    train(make_agent(**mine), dataset, updates=2, run_dir=tmp_path, **EVERY)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(TrainingError, match="another run") as error:
        train(make_agent(**mine | other), dataset, updates=4, run_dir=tmp_path, **EVERY)
    assert str(tmp_path) in str(error.value) and "\n" not in str(error.value)
    assert before == {path: path.read_bytes() for path in tmp_path.iterdir()}


def test_a_run_does_not_go_on_with_other_data(dataset, tmp_path):
    train(make_agent(), dataset, updates=2, run_dir=tmp_path, progress=False)
    other = dataclasses.replace(dataset, rewards=dataset.rewards + 1)
    with pytest.raises(TrainingError, match="was trained on other data: choose another folder"):
        train(make_agent(), other, run_dir=tmp_path, progress=False)
    assert load_agent(tmp_path / "checkpoint.safetensors").data_checksum == dataset.checksum


LOST = ["no metrics", "metrics cut off", "metrics of others", "an agent as checkpoint"]
LOST += ["target.critics.", "adam.0.", "generator."]


@pytest.mark.parametrize("damage", LOST)
def test_a_folder_that_has_lost_something_is_refused(damage, dataset, tmp_path):
    agent = make_agent()
    train(agent, dataset, updates=10, run_dir=tmp_path, **EVERY)
    if damage == "an agent as checkpoint":  # it has no moments and no generators: it cannot go on
        save_agent(agent, tmp_path / "checkpoint.safetensors")
    elif damage == "no metrics":
        (tmp_path / "metrics.csv").unlink()
    elif damage == "metrics of others":
        (tmp_path / "metrics.csv").write_text("a,b\n1,2\n")
    elif damage.endswith("."):
        (tmp_path / "checkpoint.safetensors").rename(tmp_path / "whole")
        rewritten(tmp_path / "whole", tmp_path / "checkpoint.safetensors", drop=damage)
    else:
        os.truncate(tmp_path / "metrics.csv", os.path.getsize(tmp_path / "metrics.csv") - 20)
    with pytest.raises(TrainingError) as error:
        train(make_agent(), dataset, run_dir=tmp_path, **EVERY)
    assert "\n" not in str(error.value) and str(tmp_path) in str(error.value)
