"""This module reads the options of `c2iql train` and the changes of a study's options, and describes options.

The options of `c2iql train` depend on the algorithm.
"""

import ast
import contextlib
import dataclasses
import inspect
import io
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import tyro

from tutorial_lib.agents import ALGORITHMS, Agent, get_algorithm, slug
from tutorial_lib.config import Config


@dataclasses.dataclass(frozen=True)
class Training:
    """These are the arguments of `c2iql train` that are common to all algorithms."""

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
    """This is the name of the task, e.g. BallCircle."""
    config: tyro.conf.OmitArgPrefixes[Any]
    seeds: tuple[int, ...] = (0,)
    """There is one run for each seed. The runs train together."""
    limits: tuple[float, ...] = ()
    """There is one run for each seed and each of these limits, in unsafe steps per episode. The option is
    only for algorithms that are trained for one limit. The default is the task's own limits."""
    data: str = "shipped"
    """This is `shipped`, `dsrl` or the path of a dataset file."""
    out: Path | None = None
    """This is the folder of the runs. The default is runs/TASK/ALGORITHM-PROFILE."""
    device: Literal["cpu", "cuda"] = "cpu"
    """This is the device on which the agent trains."""


def parse_training(words: Sequence[str]) -> tuple[type[Agent], Training]:
    """Returns the algorithm and the arguments of `c2iql train [ALGORITHM] TASK [options]`.

    The defaults of the options depend on the algorithm and the profile. Raises ValueError for an unknown
    name.
    """
    words = list(words)
    names = {*ALGORITHMS, *map(slug, ALGORITHMS)}
    two_names = len(words) > 1 and not any(word.startswith("-") for word in words[:2])
    kind = get_algorithm(words.pop(0) if two_names or set(words[:1]) & names else "C2IQL")
    default = kind.configure(_profile(words))
    options = dataclasses.make_dataclass(
        "Options",
        [("config", Annotated[kind.Config, tyro.conf.OmitArgPrefixes], dataclasses.field(default=default))],
        bases=(Training,),
        frozen=True,
        kw_only=True,
    )
    options.__doc__ = (
        f"Train {kind.name} and save it with its log.\n\n{(kind.__doc__ or '').strip()}\n\n"
        f"Other algorithms: c2iql train ALGORITHM --help, with one of {', '.join(map(slug, ALGORITHMS))}."
    )
    if {"-h", "--help"} & set(words):
        words = ["--help"]  # after a task, tyro's help does not show TASK
    args: Any = tyro.cli(options, args=words, prog=f"c2iql train {slug(kind.name)}")
    return kind, args


def _profile(words: Sequence[str]) -> str:
    """Returns the last profile that `words` name, or `small` where they name none."""
    profile = "small"
    for word, following in itertools.pairwise([*words, ""]):
        if word == "--profile":
            profile = following or profile  # tyro reports that the name is missing
        elif word.startswith("--profile="):
            profile = word.partition("=")[2]
    return profile


def with_options(config: Config, options: Sequence[str], others: Sequence[str] = ()) -> Config:
    """Returns the config with changes that are written `NAME=VALUE`.

    A value is read as the option's own type. The algorithms of a study have different options. A change is
    therefore ignored where its option is in `others` but not in this config. Raises ValueError for an unknown
    option and for a value of the wrong type.
    """
    types = get_type_hints(type(config))
    own = [field.name for field in dataclasses.fields(config)]
    names = [name for name in dict.fromkeys([*own, *others]) if name != "profile"]
    changes = {}
    for option in options:
        name, equals, text = option.partition("=")
        if not equals or name not in names:
            raise ValueError(f"--option {option}: write NAME=VALUE with one of {', '.join(names)}")
        if name not in own:
            continue
        said = io.StringIO()  # tyro's message describes a different command line
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                changes[name] = tyro.cli(types[name], args=[text])
        except SystemExit:
            kind = "True or False" if types[name] is bool else inspect.formatannotation(types[name])
            raise ValueError(f"--option {option}: the value must be {kind}") from None
    return config.changed(**changes)  # all changes are made together, so their order does not matter


def describe(kind: type[Config]) -> dict[str, str]:
    """Returns the meaning of each option of a class of options, by the option's name.

    The meaning is the docstring that follows the field.
    """
    words: dict[str, str] = {}
    for owner in reversed(kind.__mro__[:-1]):  # `object` is excluded
        body = ast.parse(inspect.getsource(owner)).body[0].body  # type: ignore[attr-defined]
        for field, following in zip(body, body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(following, ast.Expr):
                words[field.target.id] = " ".join(ast.literal_eval(following.value).split())  # type: ignore
    return {field.name: words[field.name] for field in dataclasses.fields(kind)}
