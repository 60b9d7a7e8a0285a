"""Wrong words on the command line. Hypothesis draws them."""

import math
from typing import get_args, get_origin, get_type_hints

from hypothesis import strategies as st

from tutorial_lib.agents import get_algorithm

NOT_FINITE = st.sampled_from([math.nan, math.inf, -math.inf])


def _is_number(text: str) -> bool:
    try:
        float(text)
        return True
    except ValueError:
        return text.strip().lower() in ("none", "true", "false", "")


WORDS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1, max_size=30)
NO_NUMBERS = WORDS.filter(lambda text: not _is_number(text))
NAMES = WORDS.filter(lambda text: text[0] not in "-~." and text.strip() and "/" not in text)
NOT_A_COUNT = st.integers(-(2**70), -1) | st.integers(10**9 + 1, 2**70)


@st.composite
def wrong_options(draw) -> tuple:
    """`c2iql train` with one option that cannot be: a number out of its bounds, or no number."""
    hints = get_type_hints(get_algorithm("C2IQL").Config, include_extras=True)
    bounded = {name: get_args(hint) for name, hint in hints.items() if get_origin(hint) is not None}
    name = draw(
        st.sampled_from([name for name, args in bounded.items() if "ClassVar" not in str(hints[name])])
    )
    kind = bounded[name][0]
    if isinstance(kind, str):  # one of some words
        value = draw(NO_NUMBERS.filter(lambda text: text not in bounded[name]))
    elif kind is int:
        value = draw(NOT_A_COUNT | NO_NUMBERS | st.floats(0.01, 0.99))
    else:
        value = draw(st.floats(-1e300, -1e-9) | st.floats(1e39, 1e300) | NO_NUMBERS | NOT_FINITE)
    return "train", "BallRun", "--data", "data.hdf5", "--out", "new", f"--{name.replace('_', '-')}={value}"


def wrong_arguments() -> st.SearchStrategy[tuple]:
    """Commands with an unknown name, a count that cannot be, or a file that is missing or in the way."""
    agent, ball = ("evaluate", "agent.safetensors"), ("train", "IQL", "BallRun", "--data", "data.hdf5")
    seeds = st.integers(-(2**70), -1) | st.integers(2**63, 2**70)
    limits = st.floats(max_value=-1e-9) | st.just(math.nan) | NO_NUMBERS
    ways = {
        ("train",): NAMES, ("collect",): NAMES, ("fetch",): NAMES, ("study",): NAMES, ("report",): NAMES,
        ("evaluate",): NAMES, ("certify",): NAMES, ("train", "IQL", "BallRun", "--data"): NAMES,
        (*ball, "--out=data.hdf5/x", "--seeds"): st.integers(0, 2**62), (*ball, "--seeds"): seeds,
        ("data", "check", "data.hdf5", "--task"): NAMES, ("study", "kappas", "--option"): NAMES,
        (*agent, "--out", "results.csv/x", "--episodes"): st.integers(1, 10), (*agent, "--limits="): limits,
        (*agent, "--episodes="): NOT_A_COUNT, (*agent, "--workers="): NOT_A_COUNT | NO_NUMBERS,
        ("collect", "BallRun", "--steps="): NOT_A_COUNT, ("collect", "BallRun", "--sources"): NAMES,
        ("study", "kappas", "--workers="): NOT_A_COUNT, ("collect", "BallRun", "--episodes="): NOT_A_COUNT,
    }  # fmt: skip

    def typing(way: tuple) -> st.SearchStrategy[tuple]:
        glued = way[-1].endswith("=")  # a negative number would be read as an option
        return ways[way].map(lambda value: (*way[:-1], f"{way[-1]}{value}") if glued else (*way, value))

    return st.sampled_from(list(ways)).flatmap(typing)
