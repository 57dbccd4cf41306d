"""Settings of what shapes the embedding beside the critic, checked before any work starts."""

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from sb3_robust_bisim.latent_models import DYNAMICS
from sb3_robust_bisim.losses import DISTANCES, ball_radius
from sb3_robust_bisim.metrics import Metric
from sb3_robust_bisim.values import is_number


@dataclass
class Objective:
    """
    Settings of the representation, checked when they are made. BisimSAC documents them; c_T is a number here.

    :raises ValueError: for a setting outside its range, or settings that contradict each other
    """

    bisim_coef: float
    c_r: float
    c_t: float
    reward_range: tuple[float, float]
    norm_constraint: bool | str
    distance: str
    dynamics: str
    nll_beta: float
    model_coef: float | None
    reward_coef: float | None
    intrinsic_reward_scale: float
    intrinsic_reward_max: float
    inverse_dynamics_coef: float
    metric_kwargs: dict[str, Any] | None

    @classmethod
    def of(cls, model: Any) -> Self:
        """
        :param model: a BisimSAC
        :return: its settings
        """
        if model.c_t is None and not (is_number(model.gamma, 0) and model.gamma < 1):
            raise ValueError(f"gamma={model.gamma!r}: it must be a number in [0, 1), because c_t=None takes its value.")
        settings = {field.name: getattr(model, field.name) for field in fields(cls)}
        return cls(**{**settings, "c_t": model.gamma if model.c_t is None else model.c_t})

    def __post_init__(self) -> None:
        is_dict = self.metric_kwargs is None or isinstance(self.metric_kwargs, dict)
        self._require(is_dict, "metric_kwargs", "None or a dict")
        for name in ("bisim_coef", "c_r", "intrinsic_reward_scale", "intrinsic_reward_max", "inverse_dynamics_coef"):
            self._require(is_number(getattr(self, name), 0), name, "a finite number >= 0")
        for name in ("model_coef", "reward_coef"):
            self._require(
                getattr(self, name) is None or is_number(getattr(self, name), 0), name, "None or a finite number >= 0"
            )
        remedy = "above 0 where bisim_coef or intrinsic_reward_scale needs the dynamics model"
        self._require(self.model_coef != 0 or not self.needs_model, "model_coef", remedy)
        remedy = "None (gamma) or a number in [0, 1), else no metric exists"
        self._require(is_number(self.c_t, 0) and self.c_t < 1, "c_t", remedy)
        ordered = bool(
            isinstance(self.reward_range, (tuple, list))
            and len(self.reward_range) == 2
            and all(map(is_number, self.reward_range))
            and self.reward_range[0] < self.reward_range[1]
        )
        self._require(ordered, "reward_range", "(R_min, R_max), finite, with R_min < R_max")
        shape = isinstance(self.norm_constraint, (bool, np.bool_)) or self.norm_constraint == "sphere"
        self._require(shape, "norm_constraint", 'True, False or "sphere"')
        point = self.in_ball and self.c_r == 0
        self._require(not point, "c_r", "above 0, or norm_constraint=False: the ball is a point")
        self._require(self.distance in tuple(DISTANCES), "distance", f"one of {', '.join(DISTANCES)}")
        self._require(self.dynamics in DYNAMICS, "dynamics", f"one of {', '.join(DYNAMICS)}")
        self._require(is_number(self.nll_beta, 0) and self.nll_beta <= 1, "nll_beta", "a number in [0, 1]")
        on_sphere = self.distance != "cosine" or self.norm_constraint == "sphere"
        self._require(on_sphere, "distance", 'another one, or norm_constraint="sphere": it is meant for unit vectors')
        known = [field.name for field in fields(Metric)][3:]
        kwargs = dict(self.metric_kwargs or {})
        for name in kwargs.keys() - known:
            raise ValueError(f"metric_kwargs with {name}={kwargs[name]!r}: it may hold {', '.join(known)}.")
        self.metric = Metric(self.distance, self.c_r, self.c_t, **kwargs)
        corrected = self.metric.loss != "variance_corrected" or self.bisim_coef == 0 or self.reward_weight > 0
        remedy = "above 0 with loss='variance_corrected', which needs the reward model; set model_coef, too"
        self._require(corrected, "reward_coef", remedy)

    def _require(self, condition: bool, name: str, remedy: str) -> None:
        if not condition:
            raise ValueError(f"{name}={getattr(self, name)!r}: it must be {remedy}.")

    @property
    def model_weight(self) -> float:
        """Weight of dynamics and reward loss: ``model_coef``, or if that is None 1 where a model is needed, else 0."""
        return float(self.needs_model) if self.model_coef is None else self.model_coef

    @property
    def reward_weight(self) -> float:
        """Weight of the reward loss: ``reward_coef``, or if that is None the weight of the models."""
        return self.model_weight if self.reward_coef is None else self.reward_coef

    @property
    def needs_model(self) -> bool:
        """Whether the metric or the bonus needs the dynamics model."""
        kwargs = self.metric_kwargs or {}
        from_model = kwargs.get("successors", "model") == "model" or kwargs.get("loss") == "variance_corrected"
        return (self.bisim_coef > 0 and from_model) or self.intrinsic_reward_scale > 0

    @property
    def in_ball(self) -> bool:
        """Whether the ball holds the embeddings."""
        return isinstance(self.norm_constraint, (bool, np.bool_)) and bool(self.norm_constraint)

    @property
    def radius(self) -> float | None:
        """Radius of the ball that holds the embeddings (eq:constraint), None without one."""
        return self.radius_of(self.reward_range) if self.in_ball else None

    def radius_of(self, reward_range: tuple[float, float]) -> float:
        """The radius that rewards of this range need."""
        return ball_radius(self.c_r, self.c_t, self.with_absorbing(reward_range))

    def with_absorbing(self, reward_range: tuple[float, float]) -> tuple[float, float]:
        """A range of rewards, widened to the 0 that absorbing states pay if the metric has them."""
        r_min, r_max = reward_range
        return (min(r_min, 0.0), max(r_max, 0.0)) if self.metric.absorbing else (r_min, r_max)

    @property
    def ratio_target(self) -> float:
        """c_R / (1 - c_T), where mu_bd / mu_rd converges to (eq:reward-dependence2)."""
        return self.c_r / (1 - self.c_t)
