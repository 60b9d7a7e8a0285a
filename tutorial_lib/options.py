"""Options for people: those of `c2iql train`, which depend on the algorithm, a study's changes, and a
table."""

import ast
import dataclasses
import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from tutorial_lib.agents import ALGORITHMS, Agent, get_algorithm, slug
from tutorial_lib.config import Config
from tutorial_lib.tasks import get_task


@dataclasses.dataclass(frozen=True)
class Training:
    """What `c2iql train` is told besides the options of the algorithm."""

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
    """Which task, e.g. BallCircle."""
    config: tyro.conf.OmitArgPrefixes[Any]
    seeds: tuple[int, ...] = (0,)
    """One run each, trained together."""
    limits: tuple[float, ...] = ()
    """Only for algorithms that are trained for one limit: every seed is trained for each of these, in unsafe
    steps per episode. Default: the task's own limits."""
    data: str = "shipped"
    """shipped, dsrl, or a file."""
    out: Path | None = None
    """Folder of the run; default runs/TASK/ALGORITHM-PROFILE."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""


def parse_training(words: list[str]) -> tuple[type[Agent], Training]:
    """The algorithm and the arguments of `c2iql train`. The profile and the task decide the options'
    defaults."""
    known = {*ALGORITHMS, *map(slug, ALGORITHMS)}
    two_words = len(words) > 1 and not words[1].startswith("-") and not words[0].startswith("-")
    name = words.pop(0) if words and (words[0] in known or two_words) else "C2IQL"
    kind = get_algorithm(name)
    task = get_task(words[0]) if words and not words[0].startswith("-") else None
    profile = "small"
    for word, following in zip(words, [*words[1:], ""], strict=True):
        if word == "--profile" or word.startswith("--profile="):
            profile = following if word == "--profile" else word.partition("=")[2]
    default = kind.configure(profile, task)
    options = dataclasses.make_dataclass(
        "Options",
        [("config", Annotated[kind.Config, tyro.conf.OmitArgPrefixes], dataclasses.field(default=default))],
        bases=(Training,),
        frozen=True,
        kw_only=True,
    )
    options.__doc__ = f"Train {kind.name}.\n\n{(kind.__doc__ or '').strip()}"
    return kind, tyro.cli(options, args=words, prog=f"c2iql train {slug(kind.name)}")


def with_options(config: Config, options: Sequence[str]) -> Config:
    """The config with `NAME=VALUE` changes; values are read as the option's own type. Raises ValueError."""
    changes = {}
    for option in options:
        name, equals, text = option.partition("=")
        if not equals:
            raise ValueError(f"--option {option}: write NAME=VALUE")
        flag = f"--{name.replace('_', '-')}"
        if name not in (names := [field.name for field in dataclasses.fields(config)]):
            raise ValueError(f"--option {option}: write NAME=VALUE with one of {', '.join(names)}")
        try:
            parsed = tyro.cli(type(config), args=[flag, text], default=config, console_outputs=False)
        except SystemExit:
            kind = type(getattr(config, name)).__name__
            raise ValueError(
                f"--option {option}: the value must be like {getattr(config, name)!r} ({kind})"
            ) from None
        changes[name] = getattr(parsed, name)
    return config.changed(**changes)


def describe(kind: type[Config]) -> dict[str, str]:
    """What each option of a class of options means, by name: the docstrings that follow the fields."""
    words: dict[str, str] = {}
    for owner in reversed(kind.__mro__[:-1]):  # not object
        body = ast.parse(inspect.getsource(owner)).body[0].body  # type: ignore[attr-defined]
        for field, following in zip(body, body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(following, ast.Expr):
                words[field.target.id] = " ".join(ast.literal_eval(following.value).split())  # type: ignore
    return {field.name: words[field.name] for field in dataclasses.fields(kind)}
