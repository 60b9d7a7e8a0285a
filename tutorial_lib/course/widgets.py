"""What a notebook shows besides figures: sliders, and the library's own code.

A control's callback is a plain function that returns a figure, so that it works, and is tested, without a
widget; where no kernel runs (GitHub, the site), the static picture after the control is drawn by it too.
"""

import inspect

import ipywidgets
import numpy as np

from tutorial_lib.course import figures, laps
from tutorial_lib.playing import rollout

SLIDER = {"continuous_update": False, "style": {"description_width": "initial"}}


class Controls(ipywidgets.interactive):
    """`ipywidgets.interactive` that shows what its callback returns, and has words for who has no kernel."""

    def __init__(self, callback, **sliders):
        super().__init__(callback, {"auto_display": True}, **sliders)

    def __repr__(self):
        names = " and ".join(widget.description for widget in self.kwargs_widgets)
        return f"(Run the notebook for sliders: {names}.)"


def play(agent, limit: float, seed: int):
    """Plays one episode under a limit, and draws it: its way, its cost so far, and the thresholds given."""
    return figures.episode(rollout(agent, [limit], [seed]), agent.task, limit)


def limit_slider(agent, limit: float = 40, seed: int = 10) -> Controls:
    """`play` with a slider for the limit, up to the task's cost range, and one for the start."""
    limits = ipywidgets.IntSlider(limit, 0, int(agent.task.cost_range), 5, description="limit", **SLIDER)
    starts = ipywidgets.IntSlider(seed, 0, 20, 1, description="start", **SLIDER)
    return Controls(lambda limit, seed: play(agent, limit, seed), limit=limits, seed=starts)


def when_it_falls(gamma: float = 0.99, start: int = 0) -> Controls:
    """`figures.falling_cost` with a slider for the discount factor and one for when the cost falls."""
    gammas = ipywidgets.SelectionSlider(
        options=[0.9, 0.95, 0.97, 0.98, 0.985, 0.99, 0.993, 0.995, 0.998, 0.999],
        value=gamma,
        description="gamma",
        **SLIDER,
    )
    starts = ipywidgets.IntSlider(start, 0, 240, 5, description="first unsafe step", **SLIDER)
    return Controls(lambda gamma, start: figures.falling_cost(gamma, start), gamma=gammas, start=starts)


def shortcut(limit: float):
    """The best policy of the tabular shortcut under a limit, and the limit's place on the Pareto frontier."""
    return figures.shortcut_under_limit(limit)


def shortcut_slider(limit: float = 1.0) -> Controls:
    """`shortcut` with a slider for the limit on the discounted cost, from 0, which none can keep."""
    limits = ipywidgets.FloatSlider(limit, min=0, max=2.75, step=0.05, description="limit", **SLIDER)
    return Controls(shortcut, limit=limits)


def spend(config, limit: float, bias: float = 1.0):
    """Notebook 07's agent under a limit: what the budget rule tells it, what it spends, what it earns."""
    told = laps.told(config, limit)
    found = laps.follow_rule(config, laps.policies(np.unique(told), bias), limit)
    title = f"limit {limit:g}, bias {bias:g}: expected cost {found.cost:.1f}, return {found.reward:.2f}"
    return figures.budget_maps({title: (told, found.chances)}, [limit])


def budget_slider(config, limit: float = 20, bias: float = 1.0) -> Controls:
    """`spend` with a slider for the limit and one for the agent's bias: thrifty below one."""
    limits = ipywidgets.IntSlider(limit, 0, 60, 5, description="limit", **SLIDER)
    biases = ipywidgets.FloatSlider(bias, min=0.4, max=1.8, step=0.1, description="bias", **SLIDER)
    return Controls(lambda limit, bias: spend(config, limit, bias), limit=limits, bias=biases)


def filter_slider(dataset, task, limit: float = 30) -> Controls:
    """`figures.filtered` with a slider for the limit, up to the task's cost range."""
    limits = ipywidgets.IntSlider(limit, 0, int(task.cost_range), 1, description="limit", **SLIDER)
    return Controls(lambda limit: figures.filtered(dataset, task, limit), limit=limits)


def head_error_slider(models, task, head: int = 2, error: float = 0.0) -> Controls:
    """`figures.head_error` with a slider for the head that errs and one for its error."""
    heads = ipywidgets.IntSlider(head, 1, len(task.gammas), description="head", **SLIDER)
    errors = ipywidgets.FloatSlider(error, min=-2, max=2, step=0.05, description="error", **SLIDER)
    return Controls(
        lambda head, error: figures.head_error(models, task, head, error), head=heads, error=errors
    )


# A state with seven recorded actions: what they promise and are expected to cost, and how frequent they are.
SEVEN_ACTIONS = (
    (12.0, 30.0, 44.0, 52.0, 60.0, -14.0, 25.0),
    (8.0, 22.0, 35.0, 41.0, 58.0, 50.0, 14.0),
    (0.2, 0.2, 0.15, 0.15, 0.1, 0.1, 0.1),
)


def penalise(limit: float, kappa: float):
    """Draws what a limit does to one state's actions, and the policy that an expectile implies there."""
    return figures.penalised_state(*SEVEN_ACTIONS, limit, kappa)


def penalty_sliders(limit: int = 40, kappa: float = 0.7) -> Controls:
    """`penalise` with sliders for the limit and for kappa."""
    limits = ipywidgets.IntSlider(limit, 0, 60, 2, description="limit", **SLIDER)
    kappas = ipywidgets.FloatSlider(value=kappa, min=0.5, max=0.99, step=0.01, description="kappa", **SLIDER)
    return Controls(penalise, limit=limits, kappa=kappas)


def seeds_slider(seeds: int = 3, spread: float = 0.05) -> Controls:
    """`figures.false_alarms` with sliders for the number of seeds and how much runs differ by luck."""
    counts = ipywidgets.IntSlider(seeds, 2, 10, 1, description="seeds", **SLIDER)
    spreads = ipywidgets.FloatSlider(spread, min=0.0, max=0.1, step=0.01, description="spread", **SLIDER)
    return Controls(figures.false_alarms, seeds=counts, spread=spreads)


def checkpoint_slider(checkpoints: int = 20, episodes: int = 5) -> Controls:
    """`figures.lucky_checkpoints` with sliders for the number of checkpoints and of episodes at each."""
    counts = ipywidgets.IntSlider(checkpoints, 1, 80, 1, description="checkpoints", **SLIDER)
    played = ipywidgets.IntSlider(episodes, 1, 40, 1, description="episodes", **SLIDER)
    return Controls(figures.lucky_checkpoints, checkpoints=counts, episodes=played)


def expectile_slider(values, kappa: float = 0.7) -> Controls:
    """`figures.expectile_of` with a slider for kappa."""
    options = [0.1, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.97, 0.99, 0.999]
    kappas = ipywidgets.SelectionSlider(options=options, value=kappa, description="kappa", **SLIDER)
    return Controls(lambda kappa: figures.expectile_of(values, kappa), kappa=kappas)


def print_lines(function, first: int, last: int | None = None) -> None:
    """Prints the paragraph of a function that its comment calls lines `first` to `last` (of Algorithm 2).

    Raises ValueError where there is none.
    """
    words = f"Line {first}:" if last is None else f"Lines {first}-{last}:"
    for paragraph in inspect.getsource(function).split("\n\n"):
        if paragraph.lstrip().startswith(f"# {words}"):
            print(inspect.cleandoc("\n" + paragraph), end="\n\n")
            return
    raise ValueError(f"no paragraph of {function.__qualname__} starts with '# {words}'")
