"""Hyperparameters: the paper's Table 4, the choices that it leaves open, and one small profile."""

import dataclasses
from dataclasses import dataclass
from typing import Literal, get_args, get_origin


@dataclass(frozen=True)
class Config:
    """Everything that a training run depends on besides its task, data, algorithm and seed.

    The defaults are the `paper` profile. Fields under "paper silent" are ours, each with its reason.
    """

    profile: str = "paper"
    """The name that results files carry."""

    # Table 4
    kappa_1: float = 0.7
    """Expectile of both value functions, V_r and V_c."""
    kappa_2: float = 0.9
    """Expectile of the policy extraction: the temperature between cloning and maximising."""
    gamma: float = 0.99
    """Discount factor of the reward, and of the cost where there is no reconstruction."""
    batch_size: int = 512
    value_lr: float = 1e-3
    """Adam's learning rate for V_r and V_c."""
    critic_lr: float = 1e-3
    """Adam's learning rate for Q_r and Q_c."""
    policy_lr: float = 3e-4
    """Adam's learning rate for the policy; decays to zero along a half cosine, as in IQL."""
    steps: int = 400_000
    """Gradient updates."""

    # Networks: "the structure follows IQL"
    hidden_width: int = 256
    hidden_layers: int = 2
    target_tau: float = 0.005
    """Polyak step of the target critics."""
    awr_alpha: float = 3.0
    """Eq. 8's temperature, for IQL alone, on rewards scaled to a range of returns of 1000 (IQL's)."""

    # Appendix B.2: the cost reconstruction model
    crm: Literal["mlp", "linear"] = "mlp"
    """'linear' is the least-squares baseline on the same data and noise."""
    crm_width: int = 512
    crm_layers: int = 5
    crm_steps: int = 1_000_000
    """Iterations of Algorithm 1 (the paper says epochs; one pass over random data has no end). A
    million of them at 5 x 512 are twice the arithmetic of all updates; on whitened inputs 20,000 at 3 x 128
    do (`data/README.md`, "Profile `paper`")."""
    crm_noise: float = 0.1
    """Standard deviation of the noise on the reconstruction model's inputs, in discounted cost."""
    crm_noise_rate: float = 0.0
    """More of it, in cost per step: head i gets this over 1 - gamma_i. The model should expect the error that
    the critics make: theirs is about 0.01 after some thousand updates, ten times what 0.1 allows for, and the
    model's alternating weights multiply it."""

    # Paper silent: we ...
    time_limits: Literal["rate", "bootstrap", "mask"] = "rate"
    """What a time limit means to the cost critics. 'rate' bootstraps through it and scales head i by
    1 - gamma_i^T before the reconstruction; 'bootstrap' leaves out the factor; 'mask' stops there, so that
    the estimate is the remaining cost and is compared with the unscaled remaining budget. (CPQ bootstraps,
    as its code does, whatever this says.)"""
    reward_time_limits: Literal["bootstrap", "mask"] = "mask"
    """What a time limit means to V_r and Q_r. 'bootstrap' is IQL's code, 'mask' is OSRL's. States at time
    limits are never trained on, and in the Run tasks nothing like them is: bootstrapping extrapolates."""
    cost_kappa: float | None = None
    """Expectile whose implicit policy the cost critics evaluate; None: kappa_1, as Algorithm 2. The policy
    that runs is extracted with kappa_2, so kappa_2 here evaluates (nearly) the policy that runs."""
    cost_critics: int = 2
    """Ensemble of cost critics; the largest reconstruction counts. 1: a single critic."""
    thresholds_per: Literal["sample", "batch"] = "sample"
    """One threshold per transition (lower variance), or one per batch as Algorithm 2's line 5 reads."""
    zero_threshold: bool = False
    """Put a zero into the threshold set {small, middle, high, infinity}: what an agent is told whose budget
    is spent. Without it the rule, eq. 23, can ask for no less than the small threshold's rate of cost."""
    infinite_at_test: Literal["covered", "nearest", "never"] = "covered"
    """When the budget rule gives the policy the infinite threshold. 'covered': once the budget left covers
    every step left, since costs are 0 or 1 and nothing can then break the limit; 'nearest': where its code is
    closest to the rescaled budget; 'never': 'the closest value' is finite."""
    normalise_observations: bool = True
    """Give the networks observations of mean zero and variance one."""
    unsafe_price: float | None = None
    """For CIQL and C2IQL; CPQ always does the first. None: an unsafe action is worth zero, as in the paper;
    where all actions are unsafe the policy is then left to chance. A number: it keeps its Q_r and pays for
    its excess over the limit, so many times the dataset's mean Q_r per cost range, as with a Lagrange
    multiplier that acts beyond the limit only."""
    recorded_step: bool = False
    """An action costs no less than the step that the data recorded of it, c + gamma V_c(s'), reconstructed.
    The critics are smooth; the step is exact about where cost sets in (a speed, a wall), and of two noisy
    estimates the higher one leaves a margin. Without it agents that move along such a line run on either side
    of it by chance."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """What hidden layers multiply in while training. bfloat16 rounds what they read, say and send back to 8
    bits; outputs, losses, parameters, Adam, the reconstruction model's training and acting stay in float32.
    Quicker in profile `paper` on a CPU with AVX512_BF16; with AMX or on a GPU never run. Several seeds
    together add biases in float32, so one seed alone differs from them by a rounding."""
    shift_rewards: bool = False
    """Train on rewards minus their dataset minimum. The zero penalty punishes only where Q_r > 0."""

    def __post_init__(self):
        """Raises ValueError for a word or a number that means nothing where it stands."""
        for field in dataclasses.fields(self):
            words, value = get_args(field.type), getattr(self, field.name)
            if get_origin(field.type) is Literal and value not in words:
                raise ValueError(f"{field.name} is {value!r}, and must be one of {', '.join(words)}")
        if self.crm == "mlp" and self.crm_width == 0:
            raise ValueError("crm_width is 0, and must be 1 or more where crm is not 'linear'")
        for names, holds, words in (
            ("kappa_1 kappa_2 cost_kappa gamma", lambda x: 0 < x < 1, "between 0 and 1"),
            ("target_tau", lambda x: 0 < x <= 1, "above 0, and 1 at most"),
            ("batch_size", lambda x: x >= 2, "2 or more"),  # half of each batch is random sequences
            ("steps hidden_width cost_critics", lambda x: x >= 1, "1 or more"),
            (
                "value_lr critic_lr policy_lr awr_alpha unsafe_price hidden_layers "
                "crm_width crm_layers crm_steps crm_noise crm_noise_rate",
                lambda x: x >= 0,
                "0 or more",
            ),
        ):
            for name in names.split():
                value = getattr(self, name)
                if value is not None and not holds(value):
                    raise ValueError(f"{name} is {value}, and must be {words}")

    @property
    def evaluated_kappa(self) -> float:
        """The expectile of the implicit policy whose cost V_c learns."""
        return self.kappa_1 if self.cost_kappa is None else self.cost_kappa


PROFILES: dict[str, Config] = {"paper": Config()}
PROFILES["small"] = dataclasses.replace(
    PROFILES["paper"],
    profile="small",
    # A laptop's size: a seventh of the arithmetic per transition, half the batch, one update in 33.
    batch_size=256,
    hidden_width=128,
    crm_width=64,
    crm_layers=2,
    crm_steps=5_000,
    steps=12_000,
    # So few steps need faster targets and a faster policy.
    target_tau=0.1,
    policy_lr=1e-3,
    # Sharper expectiles than the paper's 0.7 and 0.9.
    kappa_1=0.8,
    kappa_2=0.97,
    # Critics this young err by about 0.01 cost per step, and the reconstruction must expect it ...
    crm_noise_rate=0.01,
    # ... and where all actions look unsafe, they must be ranked.
    unsafe_price=6.0,
    # A spent budget needs a mode of its own, and a margin where cost sets in at a line.
    zero_threshold=True,
    recorded_step=True,
)


def get_profile(name: str) -> Config:
    """The profile called `name`, or ValueError that lists those there are."""
    if name not in PROFILES:
        raise ValueError(f"unknown profile {name!r}: the profiles are {', '.join(PROFILES)}")
    return PROFILES[name]
