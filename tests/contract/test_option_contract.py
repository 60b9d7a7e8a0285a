"""What every algorithm's options and words promise: limits, bounds, sentences, sources. And the template.

It belongs to `test_agent_contract`, which tests what an algorithm does.
"""

import ast
import dataclasses
import importlib.util
import inspect
import math
import re
import sys
from typing import Annotated, Literal, get_args, get_origin, get_type_hints

import algorithms
import pandas as pd
import pytest
from toys import DATA, KINDS, TASK, TEMPLATE, every_algorithm, make_agent, registered, start

from tutorial_lib.agents import ALGORITHMS, get_algorithm, slug
from tutorial_lib.config import PROFILES, Bound
from tutorial_lib.options import parse_training
from tutorial_lib.studies.grids import Grid, Study, entries
from tutorial_lib.training import train

__all__ = ["registered"]  # a fixture for every test here


# --- Limits and options ---


@every_algorithm
def test_a_limit_is_given_where_it_is_needed_and_nowhere_else(kind):
    config = make_agent(kind).config
    right, wrong = (3.0, None) if kind.needs_limit else (None, 3.0)
    assert kind(TASK, config, seeds=(1, 2), limits=right).limits == (right and (right, right))
    with pytest.raises(ValueError, match=re.escape(kind.name)):
        kind(TASK, config, limits=wrong)
    for seeds in ((), (-1,), (4, 4)):
        with pytest.raises(ValueError, match="seeds"):
            kind(TASK, config, seeds=seeds, limits=right)
    if kind.needs_limit:
        assert kind(TASK, config, seeds=(4, 4), limits=(1.0, 2.0)).limits == (1.0, 2.0)
        for bad in (-1.0, math.nan, (3.0, -1.0), (3.0,)):
            with pytest.raises(ValueError, match="limit"):
                kind(TASK, config, seeds=(1, 2), limits=bad)


@every_algorithm
def test_every_profile_makes_a_config(kind):
    for profile in PROFILES:
        config = kind.configure(profile)
        assert type(config) is kind.Config and config.profile == profile
    names = {field.name for field in dataclasses.fields(kind.Config)}
    assert set(kind.at_test) <= names


@every_algorithm
def test_an_option_that_it_does_not_read_is_an_error(kind):
    names = {field.name for field in dataclasses.fields(kind.Config)}
    others = {
        field.name: field.default for other in KINDS.values() for field in dataclasses.fields(other.Config)
    }
    for name, value in (others | {"colour": 1}).items():
        if name not in names:
            with pytest.raises(ValueError, match=name):
                kind.configure(**{name: value})
    other = next(one.Config for one in KINDS.values() if one.Config is not kind.Config)
    with pytest.raises(ValueError, match=re.escape(f"{kind.name} takes a {kind.Config.__name__}")):
        kind(TASK, other(), limits=3.0 if kind.needs_limit else None)


def parts_of(hint):
    """The types that a field takes, its bounds, and the words of a Literal."""
    bounds = []
    if get_origin(hint) is Annotated:
        hint, *rest = get_args(hint)
        bounds = [part for part in rest if isinstance(part, Bound)]
    if get_origin(hint) is Literal:
        return (), bounds, get_args(hint)
    return get_args(hint) or (hint,), bounds, ()


@every_algorithm
def test_every_option_has_a_bound_or_words_and_refuses_everything_else(kind):
    hints = get_type_hints(kind.Config, include_extras=True)
    for field in dataclasses.fields(kind.Config):
        types, bounds, words = parts_of(hints[field.name])
        wrong = [object(), ["a list"]]
        if int in types or float in types:
            assert bounds, f"{field.name} has no bound"
            out = [x for x in (-1, 0, 1, 2) if not all(bound.holds(x) for bound in bounds)]
            assert out, f"the bound of {field.name} bounds nothing"
            wrong += ["1", True, *(float(x) if int not in types else x for x in out)]
            wrong += [math.nan] if float in types else [1.5]
        else:
            assert words or types in ((bool,), (str,)), (
                f"{field.name} is neither a number, nor words, nor bool"
            )
            wrong += ["no such word"] * bool(words) + [1] * (bool in types)
        for value in wrong:
            with pytest.raises(ValueError, match=f"^{field.name} is .*and must be"):
                kind.configure().changed(**{field.name: value})


# --- Documentation ---


def documented(kind):
    """The fields of a config that a string follows in the source, with that string, as editors read them."""
    words = {}
    for owner in kind.Config.__mro__[:-1]:
        (body,) = [node.body for node in ast.parse(inspect.getsource(owner)).body]
        for field, following in zip(body, [*body[1:], None], strict=True):
            if isinstance(field, ast.AnnAssign) and isinstance(following, ast.Expr):
                words.setdefault(field.target.id, following.value.value)
    return words


@every_algorithm
def test_every_option_and_every_scalar_is_explained_in_a_sentence(kind):
    words = documented(kind)
    for field in dataclasses.fields(kind.Config):
        text = words.get(field.name, "")
        assert len(text.split()) > 2 and text.rstrip().endswith((".", "?")), f"{field.name}: {text!r}"
    agent = make_agent(kind)
    data, generators = start(agent)
    logged = agent.update(agent.draw_all(data, generators)).keys()
    assert logged <= kind.scalars.keys()
    assert {
        name for name in kind.scalars if name.endswith("_loss")
    } <= logged  # options can add other scalars
    assert all(kind.scalars.values())


@every_algorithm
def test_its_file_begins_with_its_sources_and_numbers_its_departures(kind):
    documentation = sys.modules[kind.__module__].__doc__
    paragraphs = documentation.split("\n\n")
    (sources,) = [i for i, text in enumerate(paragraphs) if text.startswith("Sources")]
    assert sources <= 2, "what it is, and then the sources"
    departures = [i for i, text in enumerate(paragraphs) if text.startswith("Departures")]
    assert all(i > sources for i in departures) and len(departures) <= 1
    assert (kind.__doc__ or "").strip(), "the class says in a sentence what it is"


# --- The template, once it stands in `agents/__init__.py` ---


def test_the_registry_is_the_only_place_that_names_an_algorithm():
    """The command line, a study, its page on the site: all know it, and no other file was changed."""
    assert get_algorithm("Weighted-cloning") is TEMPLATE
    kind, training = parse_training(["Weighted-cloning", "BallRun", "--greed", "2.5", "--seeds", "3"])
    assert kind is TEMPLATE and training.config.greed == 2.5 and training.seeds == (3,)

    specification = importlib.util.find_spec("tutorial_lib.studies.grids")
    grids = importlib.util.module_from_spec(specification)  # a copy, made under this registry
    specification.loader.exec_module(grids)
    of_table1 = [
        grid.algorithms for grid in grids.STUDIES["table1"].grids if TEMPLATE.name in grid.algorithms
    ]
    assert len(of_table1) == 1 and list(ALGORITHMS)[-1] == TEMPLATE.name

    (entry,) = entries(Study("?", (Grid(("BallRun",), (TEMPLATE.name,), ({"greed": 2.0},)),)))
    agent = entry.build()
    assert type(agent) is TEMPLATE and agent.config.greed == 2.0 and agent.seeds == (0, 1, 2)

    columns = ["task", "algorithm", "seed", "threshold", "return", "cost"]
    page = algorithms.page(TEMPLATE, pd.DataFrame(columns=columns))
    for words in (
        "# Weighted cloning",
        "MARWIL",
        "| `greed` | 10.0 |",
        "| `weight_mean` |",
        slug(TEMPLATE.name),
    ):
        assert words in page


def test_the_template_learns():
    """Without greed it plays the mean of the recorded actions, and with greed actions that earn more."""
    rewards = DATA.actions[:, 0] * 5  # the larger the first number of an action, the better
    data = dataclasses.replace(DATA, rewards=rewards.astype("float32"))
    means = {}
    for greed in (0.0, 10.0):
        agent = make_agent(TEMPLATE, [(0, None)], greed=greed, policy_lr=1e-2, critic_lr=1e-2, updates=300)
        train(agent, data, progress=False)
        means[greed] = agent.act(DATA.observations, DATA.rewards)[:, 0].mean()
    assert abs(means[0.0] - DATA.actions[:, 0].mean()) < 0.1 < means[10.0] - means[0.0]
