"""The map of the method: what C2IQL learns from, what it computes from what, and how it acts."""

from typing import NamedTuple

from matplotlib.colors import to_rgba
from matplotlib.patches import FancyBboxPatch

from tutorial_lib.style import COST, DASHED, LIMIT, REWARD, described, one_figure, subplots

DATA, POLICY = "#CC79A7", "#009E73"
UNLIT_FILL, UNLIT_EDGE, UNLIT_TEXT, ARROW = "#F3F3F3", "#C4C4C4", "#666666", "#777777"
HEIGHT = 0.56  # of half a box


class Box(NamedTuple):
    """A box of the map: its part, its place, its width, its text and its colour where it is lit."""

    part: str
    x: float
    y: float
    width: float
    text: str
    colour: str


BOXES = (
    Box("data", 5, 12.2, 5.2, "recorded data\n$(s, a, r, c, s')$", DATA),
    Box("critics", 2.3, 10, 3.2, "reward critics\n$Q_r(s, a)$", REWARD),
    Box("heads", 7.5, 10, 3.9, "$m$ cost heads\n$Q_c^{\\gamma_1}, \\dots, Q_c^{\\gamma_m}$", COST),
    Box("reconstruction", 7.5, 8, 3.9, "reconstruction $R^c$\ncost $\\hat Q_c$ of an episode", COST),
    Box("limit", 4.2, 8, 1.8, "limit $\\hat L$\ndrawn", LIMIT),
    Box("penalty", 3.1, 6, 4.8, "penalty\n$Q_{r|c} = 1[\\hat Q_c \\leq \\hat L] \\; Q_r$", REWARD),
    Box("value", 2.3, 4, 3.2, "value $V_r$\nexpectile $\\kappa_1$", REWARD),
    Box("value", 7.5, 4, 3.9, "its cost $V_c$\n$m$ values, by $\\gamma_i$", COST),
    Box("policy", 2.3, 1.6, 3.2, "policy\n$\\pi(a \\, | \\, s, \\hat L)$", POLICY),
    Box("budget", 2.3, -0.6, 3.2, "budget rule\neq. 23", POLICY),
    Box("limit", 7.5, -0.6, 3.9, "limit $L$\nof the user", LIMIT),
)
PARTS = tuple(dict.fromkeys(box.part for box in BOXES))
ROBOT = Box("robot", 7.5, 1.6, 3.9, "robot", LIMIT)  # it is no part of the method, and is never lit
# The corners of each arrow, from its start to its head.
ARROWS = (
    ((3.6, 11.64), (2.6, 10.62)),  # data -> critics
    ((6.4, 11.64), (7.4, 10.62)),  # data -> heads
    ((7.5, 9.44), (7.5, 8.62)),  # heads -> reconstruction
    ((7.5, 7.44), (7.5, 6), (5.56, 6)),  # reconstruction -> penalty
    ((4.2, 7.44), (4.2, 6.62)),  # limit -> penalty
    ((2.3, 9.44), (2.3, 6.62)),  # critics -> penalty
    ((2.3, 5.44), (2.3, 4.62)),  # penalty -> value
    ((3.9, 4), (5.49, 4)),  # value -> its cost
    ((0.7, 4), (0.2, 4), (0.2, 10), (0.64, 10)),  # value -> critics
    ((9.45, 4), (9.8, 4), (9.8, 10), (9.52, 10)),  # its cost -> heads
    ((2.3, 3.44), (2.3, 2.22)),  # value -> policy
    ((2.3, -0.04), (2.3, 0.98)),  # budget rule -> policy
    ((3.9, 1.75), (5.49, 1.75)),  # policy -> robot
    ((5.55, 1.3), (3.95, -0.2)),  # robot -> budget rule
    ((5.55, -0.75), (3.96, -0.75)),  # limit -> budget rule
)
# The words beside the arrows: where they begin or end, and to which side of it they stand.
NOTES = (
    (4.7, 4.1, "center", "$\\pi_{imp}$"),
    (2.5, 2.75, "left", "weights, $\\kappa_2$"),
    (4.7, 1.85, "center", "action"),
    (5.05, 0.1, "left", "cost so far"),
    (0.35, 7.3, "left", "$r + \\gamma V_r$"),
    (9.65, 5.0, "right", "$c + \\gamma_i V_c$"),
    (9.8, 2.75, "right", "learning"),
    (9.8, 2.15, "right", "acting"),
)
FLOW = (
    "Map of the method. Recorded data train the reward critics and m discounted cost heads. The "
    "reconstruction turns the heads into the cost of an episode. The penalty compares this cost with a "
    "limit and replaces the reward critics' values of unsafe actions. The value is an expectile of the "
    "penalised values. The value and the cost of its implicit policy are the targets of the critics and "
    "of the heads. The policy is trained with weights from the value. It acts on the robot under the "
    "limit that the budget rule computes from the user's limit and the cost so far."
)


@one_figure
def method_map(*lit: str):
    """Draws the data flow of C2IQL (Algorithm 2 and eq. 23), with the parts named in `lit` coloured.

    The names are those of `PARTS`. Learning is above the dotted line, acting is below. Raises ValueError for
    another name.
    """
    unknown = [name for name in lit if name not in PARTS]
    if unknown:
        raise ValueError(f"method_map has no part {unknown[0]!r}: its parts are {', '.join(PARTS)}")
    figure, ax = subplots(figsize=(8, 11))
    ax.set(xlim=(0, 10), ylim=(-1.3, 12.9))
    ax.set_axis_off()
    for box in (*BOXES, ROBOT):
        _draw_box(ax, box, box.part in lit)
    for *corners, last, head in ARROWS:
        ax.plot(*zip(*corners, last, strict=True), color=ARROW, linewidth=1.8, solid_joinstyle="round")
        ax.annotate("", head, last, arrowprops={"arrowstyle": "-|>", "color": ARROW, "linewidth": 1.8})
    for x, y, side, note in NOTES:
        ax.text(x, y, note, ha=side, va="bottom", color=UNLIT_TEXT, fontsize=17)
    ax.axhline(2.68, color=UNLIT_EDGE, linestyle=":", linewidth=1.5)
    return described(figure, f"{FLOW} Lit: {', '.join(dict.fromkeys(lit)) or 'no part'}.")


def _draw_box(ax, box: Box, lit: bool) -> None:
    """Draws one box, coloured where it is lit and grey otherwise."""
    corner = (box.x - box.width / 2, box.y - HEIGHT)
    fill, edge = (to_rgba(box.colour, 0.25), box.colour) if lit else (UNLIT_FILL, UNLIT_EDGE)
    shape = FancyBboxPatch(corner, box.width, 2 * HEIGHT, "round,pad=0,rounding_size=0.15")
    shape.set(facecolor=fill, edgecolor=edge, linewidth=4 if lit else 1.5)
    if lit and box.part == "limit":
        shape.set_linestyle(DASHED["linestyle"])  # as in every figure of the course
    ax.add_patch(shape)
    words = {"color": "black" if lit else UNLIT_TEXT, "fontsize": 18}
    ax.text(box.x, box.y, box.text, ha="center", va="center", linespacing=1.25, **words)
