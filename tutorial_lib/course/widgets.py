"""Sliders for the notebooks, and a function that prints paragraphs of the library's code.

The callback of a control is a plain function that returns a figure. So it can be called and tested without a
widget. Where no kernel runs, the site and the slides show pictures that the same function drew before. GitHub
shows the text of a control.
"""

import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ipywidgets
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from tutorial_lib.agents import Agent
from tutorial_lib.costs.conditioning import ConditioningConfig
from tutorial_lib.costs.reconstruction import CostReconstruction
from tutorial_lib.course import figures, laps
from tutorial_lib.course.pictures import store_pictures
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.playing import rollout
from tutorial_lib.style import Picture
from tutorial_lib.tasks import Task

SLIDER = {"continuous_update": False, "style": {"description_width": "initial"}}


class Controls(ipywidgets.interactive):
    """`ipywidgets.interactive` that displays the figure which its callback returns.

    Its text, which is shown where no kernel runs, names the sliders. If the environment variable
    C2IQL_PICTURES names a folder, the pictures of the control are written to the next of its folders
    0, 1, ... for the site and the slides.
    """

    def __init__(self, callback: Callable[..., Figure], **sliders: ipywidgets.Widget) -> None:
        super().__init__(callback, {"auto_display": True}, **sliders)
        if folder := os.environ.get("C2IQL_PICTURES"):
            store_pictures(callback, sliders, Path(folder, str(len(list(Path(folder).glob("*"))))))

    def __repr__(self) -> str:
        names = " and ".join(widget.description for widget in self.kwargs_widgets)
        return f"(Run the notebook for sliders: {names}.)"


def play(agent: Agent, limit: float, seed: int) -> Figure:
    """Plays one episode under a limit and draws its path, its cost so far, and the limits given."""
    return figures.episode(rollout(agent, [limit], [seed]), agent.task, limit)


def limit_slider(agent: Agent, limit: float = 40, seed: int = 10) -> Controls:
    """`play` with a slider for the limit, up to the task's cost range, and one for the seed of the start."""
    limits = ipywidgets.IntSlider(limit, 0, int(agent.task.cost_range), 5, description="limit", **SLIDER)
    starts = ipywidgets.IntSlider(seed, 0, 20, 1, description="start", **SLIDER)
    return Controls(lambda limit, seed: play(agent, limit, seed), limit=limits, seed=starts)


def when_it_falls(gamma: float = 0.99, start: int = 0) -> Controls:
    """`figures.falling_cost` with a slider for the discount factor and one for the first unsafe step."""
    gammas = ipywidgets.SelectionSlider(
        options=[0.9, 0.95, 0.97, 0.98, 0.985, 0.99, 0.993, 0.995, 0.998, 0.999],
        value=gamma,
        description="gamma",
        **SLIDER,
    )
    starts = ipywidgets.IntSlider(start, 0, 240, 5, description="first unsafe step", **SLIDER)
    return Controls(lambda gamma, start: figures.falling_cost(gamma, start), gamma=gammas, start=starts)


def shortcut(limit: float) -> Figure:
    """Draws the best policy of the tabular shortcut under a limit, and the limit on the Pareto frontier.

    The limit is on the discounted cost.
    """
    return figures.shortcut_under_limit(limit)


def shortcut_slider(limit: float = 1.0) -> Controls:
    """`shortcut` with a slider for the limit on the discounted cost. No policy can keep the limit 0."""
    limits = ipywidgets.FloatSlider(limit, min=0, max=2.75, step=0.05, description="limit", **SLIDER)
    return Controls(shortcut, limit=limits)


def spend(config: ConditioningConfig, limit: float, bias: float = 1.0) -> Figure:
    """Draws what notebook 9's agent does under a limit: the thresholds given, its cost and its return."""
    told = laps.told(config, limit)
    found = laps.follow_rule(config, laps.policies(np.unique(told), bias), limit)
    title = f"limit {limit:g}, bias {bias:g}: expected cost {found.cost:.1f}, return {found.reward:.2f}"
    return figures.budget_maps({title: (told, found.chances)}, [limit])


def budget_slider(config: ConditioningConfig, limit: float = 20, bias: float = 1.0) -> Controls:
    """`spend` with a slider for the limit and one for the agent's bias (see `laps.policies`)."""
    limits = ipywidgets.IntSlider(limit, 0, 60, 5, description="limit", **SLIDER)
    biases = ipywidgets.FloatSlider(bias, min=0.4, max=1.8, step=0.1, description="bias", **SLIDER)
    return Controls(lambda limit, bias: spend(config, limit, bias), limit=limits, bias=biases)


def filter_slider(dataset: Dataset, task: Task, limit: float = 30) -> Controls:
    """`figures.filtered` with a slider for the limit, up to the task's cost range."""
    limits = ipywidgets.IntSlider(limit, 0, int(task.cost_range), 1, description="limit", **SLIDER)
    return Controls(lambda limit: figures.filtered(dataset, task, limit), limit=limits)


def head_error_slider(
    models: dict[str, CostReconstruction], task: Task, head: int = 2, error: float = 0.0
) -> Controls:
    """`figures.head_error` with a slider for the head that is wrong, counted from 1, and one for its error.

    The error is in discounted cost. `models` are reconstruction models by name.
    """
    heads = ipywidgets.IntSlider(head, 1, len(task.gammas), description="head", **SLIDER)
    errors = ipywidgets.FloatSlider(error, min=-2, max=2, step=0.05, description="error", **SLIDER)
    return Controls(
        lambda head, error: figures.head_error(models, task, head, error), head=heads, error=errors
    )


# A state with seven recorded actions: their Q_r, the expected cost of an episode, and their probability.
SEVEN_ACTIONS = (
    (12.0, 30.0, 44.0, 52.0, 60.0, -14.0, 25.0),
    (8.0, 22.0, 35.0, 41.0, 58.0, 50.0, 14.0),
    (0.2, 0.2, 0.15, 0.15, 0.1, 0.1, 0.1),
)


def penalise(limit: float, kappa: float) -> Figure:
    """Draws the penalised Q of one state's actions under a limit, and the implicit policy of an expectile."""
    return figures.penalised_state(*SEVEN_ACTIONS, limit, kappa)


def penalty_sliders(limit: int = 40, kappa: float = 0.7) -> Controls:
    """`penalise` with a slider for the limit and one for kappa."""
    limits = ipywidgets.IntSlider(limit, 0, 60, 2, description="limit", **SLIDER)
    kappas = ipywidgets.FloatSlider(value=kappa, min=0.5, max=0.99, step=0.01, description="kappa", **SLIDER)
    return Controls(penalise, limit=limits, kappa=kappas)


def seeds_slider(seeds: int = 3, spread: float = 0.05) -> Controls:
    """`figures.false_alarms` with sliders for the number of seeds and the standard deviation between runs."""
    counts = ipywidgets.IntSlider(seeds, 2, 10, 1, description="seeds", **SLIDER)
    spreads = ipywidgets.FloatSlider(spread, min=0.0, max=0.1, step=0.01, description="spread", **SLIDER)
    return Controls(figures.false_alarms, seeds=counts, spread=spreads)


def checkpoint_slider(checkpoints: int = 20, episodes: int = 5) -> Controls:
    """`figures.lucky_checkpoints` with sliders for the number of checkpoints and of episodes at each."""
    counts = ipywidgets.IntSlider(checkpoints, 1, 80, 1, description="checkpoints", **SLIDER)
    played = ipywidgets.IntSlider(episodes, 1, 40, 1, description="episodes", **SLIDER)
    return Controls(figures.lucky_checkpoints, checkpoints=counts, episodes=played)


def expectile_slider(actions: ArrayLike, q: ArrayLike, kappa: float = 0.7) -> Controls:
    """`figures.expectile_of` for actions (n,) of one state and their Q (n,), with a slider for kappa."""
    options = [0.1, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.97, 0.99, 0.999]
    kappas = ipywidgets.SelectionSlider(options=options, value=kappa, description="kappa", **SLIDER)
    return Controls(lambda kappa: figures.expectile_of(actions, q, kappa), kappa=kappas)


def print_lines(function: Callable[..., Any], first: int, last: int | None = None) -> None:
    """Prints the paragraph of a function's code whose comment says lines `first` to `last` of Algorithm 2.

    Raises ValueError where there is no such paragraph.
    """
    words = f"Line {first}:" if last is None else f"Lines {first}-{last}:"
    for paragraph in inspect.getsource(function).split("\n\n"):
        if paragraph.lstrip().startswith(f"# {words}"):
            print(inspect.cleandoc("\n" + paragraph), end="\n\n")
            return
    raise ValueError(f"no paragraph of {function.__qualname__} starts with '# {words}'")


def sums_slider(task: Task, cost: float = 60, known: int = 1) -> Controls:
    """`figures.extremal_sequences` with a slider for the steady cost and one for the number of known sums.

    One sum is that of the first discount factor; two are those of the first and the last.
    """
    middle = range(1, len(task.gammas) - 1)
    choices = [(0, *middle[: m - 2], -1) if m > 1 else (0,) for m in range(1, len(task.gammas) + 1)]
    costs = ipywidgets.IntSlider(cost, 5, int(task.cost_range), 5, description="unsafe steps", **SLIDER)
    counts = ipywidgets.IntSlider(known, 1, len(choices), description="known sums", **SLIDER)
    return Controls(
        lambda cost, known: figures.extremal_sequences(task, cost, [choices[known - 1]]),
        cost=costs,
        known=counts,
    )


def price(limit: float, price: float) -> Picture:
    """Draws a price of cost on the tabular shortcut: the slope that it means, and its bound g(price)."""
    return figures.price_of_limit(limit, price)


def price_slider(limit: float = 1.0, start: float = 0.2) -> Controls:
    """`price` with a slider for the price of a unit of discounted cost. The limit stays as it is."""
    prices = ipywidgets.FloatSlider(start, min=0, max=2, step=0.05, description="price", **SLIDER)
    return Controls(lambda price: figures.price_of_limit(limit, price), price=prices)


def charge(limit: float, price: float) -> Figure:
    """Draws the priced Q of the state of `penalise` under a limit, and the implicit policy for kappa 0.9.

    The price is in reward per unsafe step beyond the limit.
    """
    return figures.penalised_state(*SEVEN_ACTIONS, limit, kappa=0.9, price=price)


def charge_sliders(limit: int = 20, price: float = 2.0) -> Controls:
    """`charge` with a slider for the limit and one for the price."""
    limits = ipywidgets.IntSlider(limit, 0, 60, 2, description="limit", **SLIDER)
    prices = ipywidgets.FloatSlider(price, min=0.0, max=5.0, step=0.25, description="price", **SLIDER)
    return Controls(charge, limit=limits, price=prices)
