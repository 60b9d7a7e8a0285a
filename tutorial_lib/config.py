"""Options: what every run has. An algorithm's own options stand in its file, in a class derived from
`Config`.

Every option has a type, a default (profile `paper`), bounds and a sentence. `c2iql train ALGORITHM --help`
shows them, and the file of an agent keeps them.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, get_args, get_origin, get_type_hints


class Bound(NamedTuple):
    """What a number must fulfil."""

    holds: Callable[[float], bool]
    words: str


SHARE = Bound(lambda x: 0 < x < 1, "between 0 and 1")
STEP = Bound(lambda x: 0 < x <= 1, "above 0, and 1 at most")
NOT_NEGATIVE = Bound(lambda x: x >= 0, "0 or more")
COUNT = Bound(lambda x: x >= 1, "1 or more")
PAIR = Bound(lambda x: x >= 2, "2 or more")

PROFILES = ("paper", "small")
"""`paper`: the sizes of the paper. `small`: trains in minutes on a laptop."""


@dataclass(frozen=True)
class Config:
    """The options of every algorithm. The defaults are profile `paper` (Table 4 and Appendix B.2).

    Raises ValueError for a word or a number that means nothing where it stands.
    """

    profile: str = "paper"
    """The name that results files carry."""
    updates: Annotated[int, COUNT] = 400_000
    """Gradient updates (Table 4)."""
    batch_size: Annotated[int, PAIR] = 512
    """Transitions per update (Table 4)."""
    policy_lr: Annotated[float, NOT_NEGATIVE] = 3e-4
    """Adam's learning rate for the policy (Table 4)."""
    hidden_width: Annotated[int, COUNT] = 256
    """Units of each hidden layer. The paper says that the structure follows IQL."""
    hidden_layers: Annotated[int, NOT_NEGATIVE] = 2
    """Hidden layers of each network; 0: a linear network."""
    normalise_observations: bool = True
    """Give the networks observations of mean zero and variance one. The paper does not say whether it
    does."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """The numbers that hidden layers multiply while training. With bfloat16, inputs, outputs and gradients of
    hidden layers have 8-bit mantissas; last layers, losses, parameters, Adam, the reconstruction model's
    training and acting stay in float32. It is faster in profile `paper` on a CPU with AVX512_BF16. It has not
    been run with AMX or on a GPU."""

    profiles: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        # A laptop's size: a seventh of the arithmetic per transition, half the batch, one update in 33.
        "small": {"updates": 12_000, "batch_size": 256, "hidden_width": 128, "policy_lr": 1e-3},
    }
    """What a profile changes in the defaults of this class. A derived class adds its own changes."""
    tasks: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """What a task changes in profile `small`, by the task's name."""

    def __post_init__(self):
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            if get_origin(hint) is not ClassVar:
                _check(name, hint, getattr(self, name))

    @classmethod
    def make(cls, profile: str = "small", task: str | None = None) -> Self:
        """The options of a profile, with those of a task's own where one is named. Raises ValueError."""
        if profile not in PROFILES:
            raise ValueError(f"unknown profile {profile!r}: the profiles are {', '.join(PROFILES)}")
        changes: dict[str, Any] = {"profile": profile}
        for kind in reversed(cls.__mro__):
            changes |= vars(kind).get("profiles", {}).get(profile, {})
        if profile == "small":
            changes |= cls.tasks.get(task or "", {})
        return cls(**changes)

    def changed(self, **changes: Any) -> Self:
        """These options with other values of some. Raises ValueError for a name that is not among them."""
        names = [field.name for field in dataclasses.fields(self)]
        if unknown := [name for name in changes if name not in names]:
            raise ValueError(f"no option {', '.join(unknown)} here: the options are {', '.join(names)}")
        return dataclasses.replace(self, **changes)  # all at once: what fits together may come in any order


def _check(name: str, hint: Any, value: Any) -> None:
    """ValueError where the value is none of a Literal's words, of another type, or out of its bound."""
    bounds: tuple = ()
    if get_origin(hint) is Annotated:
        hint, *rest = get_args(hint)
        bounds = tuple(bound for bound in rest if isinstance(bound, Bound))
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise ValueError(f"{name} is {value!r}, and must be one of {', '.join(map(str, get_args(hint)))}")
        return
    kinds = get_args(hint) or (hint,)
    if value is None and type(None) in kinds:
        return
    whole = isinstance(value, int) and not isinstance(value, bool)
    if not (
        isinstance(value, kinds) and isinstance(value, bool) == (bool in kinds) or whole and float in kinds
    ):
        words = " or ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"{name} is {value!r}, and must be of type {words}")
    for bound in bounds:
        if not bound.holds(value):
            raise ValueError(f"{name} is {value}, and must be {bound.words}")
