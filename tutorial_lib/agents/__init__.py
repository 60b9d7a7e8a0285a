"""The algorithms, by the names that the command line and the results files use.

To add an algorithm, write its file and add its class to `ALGORITHMS`.
"""

import re

from tutorial_lib.agents.agent import Agent
from tutorial_lib.agents.bc import BCAll, BCBudget, BCFrontier, BCSafe
from tutorial_lib.agents.bcq import BCQLag
from tutorial_lib.agents.bear import BEARLag
from tutorial_lib.agents.c2iql import C2IQL, C2IQLWithoutCC, C2IQLWithoutCR
from tutorial_lib.agents.caps import CAPS
from tutorial_lib.agents.cdt import CDT
from tutorial_lib.agents.ciql import CIQL
from tutorial_lib.agents.coptidice import COptiDICE
from tutorial_lib.agents.cpq import CPQ, PushedCPQ
from tutorial_lib.agents.fisor import FISOR
from tutorial_lib.agents.iql import IQL
from tutorial_lib.agents.voce import VOCE
from tutorial_lib.agents.wsac import WSAC

ALGORITHMS: dict[str, type[Agent]] = {
    agent.name: agent
    for agent in (
        IQL,
        CIQL,
        C2IQLWithoutCR,
        C2IQLWithoutCC,
        C2IQL,
        BCAll,
        BCSafe,
        BCFrontier,
        BCBudget,
        CPQ,
        PushedCPQ,
        COptiDICE,
        FISOR,
        CDT,
        BCQLag,
        BEARLag,
        CAPS,
        WSAC,
        VOCE,
    )
}
"""The class of every algorithm, by its name."""


def get_algorithm(name: str) -> type[Agent]:
    """Returns the class of the algorithm with this name or slug. Raises ValueError for an unknown name."""
    name = {slug(known): known for known in ALGORITHMS}.get(name, name)
    if name not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {name!r}: the algorithms are {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]


def slug(name: str) -> str:
    """Returns a name as the command line and folders write it, e.g. C2IQL-wo-CR for 'C2IQL w/o CR'."""
    return re.sub(r"[^\w-]", "", name.replace(" ", "-"))
