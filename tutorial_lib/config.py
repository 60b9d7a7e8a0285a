"""The options that every algorithm has. An algorithm's file derives a class from `Config` for its own.

Every option has a type, a default (that of profile `paper`), a bound on its numbers and a description.
`c2iql train ALGORITHM --help` shows them, and the file of an agent stores their values.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, get_args, get_origin, get_type_hints


class Bound(NamedTuple):
    """A condition on the number that an option may have."""

    holds: Callable[[float], bool]
    """Returns whether a number fulfils the condition."""
    words: str
    """The condition in words, for an error message."""


SHARE = Bound(lambda x: 0 < x < 1, "between 0 and 1")
RESERVE = Bound(lambda x: 0 <= x < 1, "0 or more, and below 1")
STEP = Bound(lambda x: 0 < x <= 1, "above 0 and at most 1")
POSITIVE = Bound(lambda x: x > 0, "above 0")
NOT_NEGATIVE = Bound(lambda x: x >= 0, "0 or more")
COUNT = Bound(lambda x: x >= 1, "1 or more")
PAIR = Bound(lambda x: x >= 2, "2 or more")

LARGEST = {
    "updates": 100_000_000, "crm_steps": 100_000_000, "warm_up": 100_000_000,
    "batch_size": 65_536, "hidden_width": 8_192, "hidden_layers": 64, "crm_width": 8_192, "crm_layers": 64,
}  # fmt: skip
"""The largest values of options that are whole numbers. They hold whatever the algorithm, and are far above
what anybody trains with: a slip of the keyboard must not take all memory, or all time."""
MANY = 1_000
"""The largest value of every other whole number. Such options count networks, heads, samples or tokens."""
LARGEST_FLOAT32 = 3.4e38

PROFILES = ("paper", "small", "printed")
"""Three sets of defaults. `paper` has the sizes of the paper. `small` is the course's recipe, which trains in
minutes on a laptop. `printed` has the sizes of `small` and, in all else, what the paper prints."""

_LAPTOP = {"updates": 12_000, "batch_size": 256, "hidden_width": 128, "policy_lr": 1e-3}
"""Sizes for a laptop: 1/7 of the arithmetic per transition, 1/2 of the batch and 1/33 of the updates."""


@dataclass(frozen=True)
class Config:
    """The options of every algorithm. The defaults are profile `paper` (Table 4 and Appendix B.2).

    Raises ValueError for a value of another type, an unknown word, or a number out of its bound.
    """

    profile: str = "paper"
    """The name of the profile. Results files contain it."""
    updates: Annotated[int, COUNT] = 400_000
    """The number of gradient updates of a run (Table 4)."""
    batch_size: Annotated[int, PAIR] = 512
    """The number of transitions per update (Table 4)."""
    policy_lr: Annotated[float, NOT_NEGATIVE] = 3e-4
    """Adam's learning rate for the policy (Table 4)."""
    hidden_width: Annotated[int, COUNT] = 256
    """The number of units of each hidden layer. The paper says that the structure follows IQL."""
    hidden_layers: Annotated[int, NOT_NEGATIVE] = 2
    """The number of hidden layers of each network. With 0 the network is linear."""
    normalise_observations: bool = True
    """If true, observations are scaled to mean zero and variance one. The paper does not say whether it does
    this."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """The number format in which hidden layers multiply during training. With bfloat16, the inputs, outputs
    and gradients of hidden layers have 8-bit mantissas. Last layers, losses, parameters, Adam, the training
    of the reconstruction model and acting stay in float32. Training with bfloat16 is faster in profile
    `paper` on a CPU with AVX512_BF16. It has not been run with AMX or on a GPU."""

    profiles: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "small": _LAPTOP,
        "printed": _LAPTOP | {"normalise_observations": False},
    }
    """The values that a profile changes in the defaults of this class. A derived class adds its own."""

    def __post_init__(self):
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            if get_origin(hint) is not ClassVar:
                _check(name, hint, getattr(self, name))

    @classmethod
    def make(cls, profile: str = "small") -> Self:
        """Returns the options of a profile. They are the same for every task.

        Raises ValueError for an unknown profile.
        """
        if profile not in PROFILES:
            raise ValueError(f"unknown profile {profile!r}: the profiles are {', '.join(PROFILES)}")
        changes: dict[str, Any] = {"profile": profile}
        for kind in reversed(cls.__mro__):
            changes |= vars(kind).get("profiles", {}).get(profile, {})
        return cls(**changes)

    def changed(self, **changes: Any) -> Self:
        """Returns these options with other values for some of them.

        Raises ValueError for an unknown name, or for a value that the option cannot have.
        """
        names = [field.name for field in dataclasses.fields(self)]
        if unknown := [name for name in changes if name not in names]:
            raise ValueError(f"unknown option {', '.join(unknown)}: the options are {', '.join(names)}")
        return dataclasses.replace(self, **changes)  # all at once, because some values fit only together


def _check(name: str, hint: Any, value: Any) -> None:
    """Raises ValueError for a value of another type, an unknown word, or a number out of its bound."""
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
    if int in kinds and value > (most := LARGEST.get(name, MANY)):
        raise ValueError(f"{name} is {value}, and must be at most {most:,}")
    if float in kinds and not abs(value) <= LARGEST_FLOAT32:
        raise ValueError(f"{name} is {value}, and must be a finite number of float32")
