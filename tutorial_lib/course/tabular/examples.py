"""The shortcut, which is the course's running example, and random CMDPs."""

from collections.abc import Sequence

import numpy as np

from tutorial_lib.course.tabular.cmdp import CMDP

ARROWS = ("↑", "→", "↓", "←")
_MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))
# S is the start, G the goal, h a hazard. Three paths lead to the goal: straight through the hazards (4 steps,
# 3 of them hazardous), over the middle row (6 steps, 1 of them hazardous), and around (8 steps, none of
# them).
SHORTCUT = ("     ", "  h  ", "ShhhG")


def shortcut(slip: float = 0.1, gamma: float = 0.9, layout: Sequence[str] = SHORTCUT) -> CMDP:
    """The course's running example: a grid in which the short path leads through hazards.

    The states are the cells of `layout`: state row * columns + column is the cell (row, column). The four
    actions are moves in the directions `ARROWS`. An action on a hazard costs 1, an action on the goal earns
    1, and the goal is never left. With probability `slip` the direction of a move is replaced by a random one
    of the four. A move that would leave the grid leaves the state unchanged.
    """
    rows, columns = len(layout), len(layout[0])
    cells = np.array([list(row) for row in layout]).ravel()
    transitions = np.zeros((len(cells), 4, len(cells)))
    for state in range(len(cells)):
        for action in range(4):
            for move, (down, right) in enumerate(_MOVES):
                chance = slip / 4 + (1 - slip) * (move == action)
                row = min(max(state // columns + down, 0), rows - 1)
                column = min(max(state % columns + right, 0), columns - 1)
                transitions[state, action, row * columns + column] += chance
    goal = cells == "G"
    transitions[goal] = np.eye(len(cells))[goal, None]
    rewards, costs = (np.repeat((cells == kind)[:, None].astype(float), 4, axis=1) for kind in "Gh")
    return CMDP(transitions, rewards, costs, (cells == "S").astype(float), gamma)


def random_cmdp(
    rng: np.random.Generator, states: int = 6, actions: int = 3, gamma: float = 0.9, branching: int = 3
) -> CMDP:
    """A random CMDP: actions lead to `branching` states, rewards are uniform in (0, 1), costs are 0 or 1."""
    transitions = np.zeros((states, actions, states))
    for row in transitions.reshape(-1, states):
        row[rng.permutation(states)[:branching]] = rng.dirichlet(np.ones(branching))
    rewards = rng.random((states, actions))
    costs = (rng.random((states, actions)) < 0.4).astype(float)
    return CMDP(transitions, rewards, costs, rng.dirichlet(np.ones(states)), gamma)
