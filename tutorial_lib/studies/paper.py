"""The results that the paper reports, for every table and figure that shows them beside ours.

They are always labelled as the paper's, and they are never a target. The paper's results are on DSRL's data,
with the settings of profile `paper` and five seeds. Ours are on data of our own. Figures 3, 4 and 7 are
learning curves without printed values: what the paper's text says about them stands here as claims that can
be tested.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

COLUMNS = "AntRun BallRun CarRun DroneRun AntCircle BallCircle CarCircle DroneCircle".split()
_TABLE1 = {
    "BCQ-Lag": ("0.56 0.27 0.92 0.76 0.76 0.64 0.67 0.96", "0.28 0.39 0.10 1.62 1.73 0.98 1.23 2.09"),
    "BEAR-Lag": ("0.14 0.22 0.80 0.02 0.41 0.75 0.73 0.85", "0.02 1.97 3.71 0.89 1.10 1.18 1.50 1.59"),
    "COptiDICE": ("0.57 0.47 0.90 0.63 0.19 0.62 0.43 0.40", "0.22 1.25 0.00 1.40 0.91 0.99 1.20 0.42"),
    "CPQ": ("0.05 0.63 0.94 0.33 0.02 0.63 0.59 0.13", "0.00 1.41 1.42 1.62 0.06 0.87 1.03 0.24"),
    "FISOR": ("0.18 0.24 0.80 0.20 0.11 0.25 0.23 0.46", "0.00 0.00 0.01 0.41 0.00 0.03 0.00 0.00"),
    "VOCE": ("0.32 0.79 0.43 0.48 0.00 0.85 0.39 0.12", "0.86 1.04 6.58 1.58 1.01 1.34 1.43 0.57"),
    "WSAC": ("0.25 0.80 0.86 0.66 0.40 0.69 0.61 0.02", "0.18 1.98 0.40 2.52 0.98 0.78 0.51 0.45"),
    "CDT": ("0.72 0.56 0.95 0.66 0.54 0.78 0.72 0.75", "1.00 0.97 0.80 0.73 0.96 0.96 0.95 0.97"),
    "C2IQL": ("0.74 0.59 0.95 0.71 0.66 0.72 0.74 0.78", "0.94 0.95 0.08 0.73 0.76 0.85 0.93 0.85"),
}
TABLE1: dict[str, dict[str, tuple[float, float]]] = {
    algorithm: dict(zip(COLUMNS, zip(*(map(float, row.split()) for row in rows), strict=True), strict=True))
    for algorithm, rows in _TABLE1.items()
}
"""The paper's Table 1: normalised reward and cost by algorithm and task, means over seeds and limits."""

OUR_NAMES = {"WSAC": "WSAC-style"}
"""What we call the systems of Table 1 whose exact form was not published."""
TABLE1_AVERAGES = {
    "BCQ-Lag": (0.69, 1.05),
    "BEAR-Lag": (0.49, 1.49),
    "COptiDICE": (0.53, 0.80),
    "CPQ": (0.41, 0.83),
    "FISOR": (0.31, 0.06),
    "VOCE": (0.42, 1.80),
    "WSAC": (0.54, 0.97),
    "CDT": (0.71, 0.91),
    "C2IQL": (0.74, 0.76),
}
"""The last column of Table 1, as printed: the averages over the tasks."""

TABLE1_STD = {
    "AntRun": (0.01, 0.05),
    "BallRun": (0.05, 0.07),
    "CarRun": (0.01, 0.17),
    "DroneRun": (0.02, 0.16),
    "AntCircle": (0.06, 0.13),
    "BallCircle": (0.03, 0.07),
    "CarCircle": (0.01, 0.07),
    "DroneCircle": (0.02, 0.11),
}
"""The standard deviations in Table 1, of C2IQL's normalised reward and cost.

The paper does not say over what they are taken.
"""

TABLE2 = {
    "noise": (0.0, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 4.0),
    "mse": (0.025, 1.10, 1.77, 2.25, 3.35, 4.41, 5.76, 7.84),
    "return": (434.01, 435.07, 442.08, 435.67, 435.60, 421.82, 408.77, 401.89),
    "cost": (46.60, 47.20, 48.30, 47.30, 47.89, 42.10, 34.90, 36.20),
}
"""The paper's Table 2, on CarCircle under the limit 50. The paper gives no spread and no number of seeds.

The noise is a standard deviation in discounted cost. Return and cost are those of an episode, not
normalised."""


@dataclass(frozen=True)
class Claim:
    """A statement of the paper: `score` is larger in some rows of a study's results than in others."""

    study: str
    """The name of the study that tests it."""
    words: str
    """The statement, for people."""
    source: str
    """Where the paper says it: section, figure or table."""
    score: str
    """The column to compare: 'reward_score' or 'cost_score'."""
    high: dict
    """Values of columns. They select the rows where the score is larger."""
    low: dict | float
    """The same for the rows where it is smaller, or a number to compare with."""
    where: dict = field(default_factory=dict)
    """Values of columns that both have."""


def _algorithm(name: str) -> dict:
    return {"algorithm": name}


def _noise(level: float) -> dict:
    return {"crm_noise": level}


def _ablation(
    words: str, score: str, high: str, low: str, tasks: Sequence[str] = ("CarCircle", "DroneCircle")
) -> list[Claim]:
    """One claim per task about two ablations, from Fig. 3 for CarCircle and from Fig. 7 for DroneCircle."""
    source = {"CarCircle": "4.2, Fig. 3", "DroneCircle": "B.3, Fig. 7"}
    sides = _algorithm(high), _algorithm(low)
    return [Claim("ablations", words, source[task], score, *sides, {"task": task}) for task in tasks]


# CarCircle's middle threshold. Where one expectile varies, the other has the value of Table 4.
MIDDLE = {"threshold": 50}
REWARD, COST = "reward_score", "cost_score"
CLAIMS = (
    *_ablation("C2IQL earns more than without cost reconstruction", REWARD, "C2IQL", "C2IQL w/o CR"),
    *_ablation("C2IQL earns more than without conditioning", REWARD, "C2IQL", "C2IQL w/o CC"),
    *_ablation("C2IQL earns more than CIQL", REWARD, "C2IQL", "CIQL"),
    *_ablation("CIQL pays less than C2IQL", COST, "C2IQL", "CIQL"),
    *_ablation("without conditioning, less cost is paid", COST, "C2IQL", "C2IQL w/o CC", ("CarCircle",)),
    Claim(
        "kappas",
        "kappa_1 = 0.9 pays more than 0.5",
        "4.3, Fig. 4",
        COST,
        {"kappa_1": 0.9},
        {"kappa_1": 0.5},
        MIDDLE | {"kappa_2": 0.9},
    ),
    Claim(
        "kappas",
        "kappa_1 = 0.9 breaks the limit",
        "4.3, Fig. 4",
        COST,
        {"kappa_1": 0.9},
        1.0,
        MIDDLE | {"kappa_2": 0.9},
    ),
    Claim(
        "kappas",
        "kappa_2 = 0.9 earns more than 0.5",
        "4.3, Fig. 4",
        REWARD,
        {"kappa_2": 0.9},
        {"kappa_2": 0.5},
        MIDDLE | {"kappa_1": 0.7},
    ),
    Claim(
        "crm-noise",
        "a little noise (0.2) earns more than none",
        "4.4, Table 2",
        REWARD,
        _noise(0.2),
        _noise(0.0),
        MIDDLE,
    ),
    Claim(
        "crm-noise",
        "much noise (4.0) earns less than a little (0.2)",
        "4.4, Table 2",
        REWARD,
        _noise(0.2),
        _noise(4.0),
        MIDDLE,
    ),
    Claim(
        "crm-noise",
        "much noise (4.0) pays less than a little (0.2)",
        "4.4, Table 2",
        COST,
        _noise(0.2),
        _noise(4.0),
        MIDDLE,
    ),
    *(
        Claim(
            "table1",
            "C2IQL earns more than CPQ where that is safe",
            "4.1, Table 1",
            REWARD,
            _algorithm("C2IQL"),
            _algorithm("CPQ"),
            {"task": task},
        )
        for task, (_, cost) in TABLE1["CPQ"].items()
        if cost <= 1
    ),
)
"""What the paper's text says about its figures and tables, as comparisons that our results can test."""
