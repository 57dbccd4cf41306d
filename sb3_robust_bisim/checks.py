"""What BisimSAC refuses before any work starts. Each message names the argument, its value and the remedy."""

import difflib
import inspect
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.sac.sac import SAC

from sb3_robust_bisim.latent_models import DYNAMICS
from sb3_robust_bisim.losses import DISTANCES
from sb3_robust_bisim.policies import BisimPolicy, MlpPolicy, MultiInputPolicy

if TYPE_CHECKING:
    from sb3_robust_bisim.bisim_sac import BisimSAC


def check_arguments(model: "BisimSAC") -> None:
    """
    :param model: as it is before its nets are built
    :raises ValueError: for an argument outside its range, or arguments that contradict each other
    """
    for name in ("bisim_coef", "c_r", "intrinsic_reward_scale", "intrinsic_reward_max", "inverse_dynamics_coef"):
        _require(_is_number(getattr(model, name), 0), model, name, "a finite number >= 0")
    _require(model.model_coef is None or _is_number(model.model_coef, 0), model, "model_coef", "None or a finite number >= 0")
    needed = model.bisim_coef > 0 or model.intrinsic_reward_scale > 0
    trained = model.model_coef != 0 or not needed
    _require(trained, model, "model_coef", "above 0 where bisim_coef or intrinsic_reward_scale needs the dynamics model")
    gamma_fits = model.c_t is not None or 0 <= model.gamma < 1
    _require(gamma_fits, model, "gamma", "in [0, 1) when c_t is None, which stands for gamma")
    below_one = model.c_t is None or (_is_number(model.c_t, 0) and model.c_t < 1)
    _require(below_one, model, "c_t", "None (gamma) or in [0, 1), else no metric exists")
    ordered = bool(
        isinstance(model.reward_range, (tuple, list))
        and len(model.reward_range) == 2
        and all(map(_is_number, model.reward_range))
        and model.reward_range[0] < model.reward_range[1]
    )
    _require(ordered, model, "reward_range", "(R_min, R_max), finite, with R_min < R_max")
    for name in ("norm_constraint", "bf16"):
        _require(isinstance(getattr(model, name), (bool, np.bool_)), model, name, "True or False")
    point = model.norm_constraint and model.c_r == 0
    _require(not point, model, "c_r", "above 0, or norm_constraint=False: the ball is a point")
    _require(model.distance in DISTANCES, model, "distance", f"one of {', '.join(DISTANCES)}")
    _require(model.dynamics in DYNAMICS, model, "dynamics", f"one of {', '.join(DYNAMICS)}")
    for name, least in (("policy_delay", 1), ("initial_gradient_steps", 0)):
        value = getattr(model, name)
        _require(isinstance(value, (int, np.integer)) and value >= least, model, name, f"an integer >= {least}")

    n_steps = model.n_steps if model.n_steps != 1 else model.replay_buffer_kwargs.get("n_steps", 1)
    buffer_class = model.replay_buffer_class
    if n_steps != 1 or (buffer_class is not None and issubclass(buffer_class, NStepReplayBuffer)):
        raise ValueError(
            f"n_steps={n_steps} (replay_buffer_class={buffer_class}): dynamics, inverse dynamics and metric are about one "
            "step. Use n_steps=1 and no NStepReplayBuffer."
        )
    if model.intrinsic_reward_scale > 0 and buffer_class is not None and issubclass(buffer_class, HerReplayBuffer):
        raise ValueError(
            f"intrinsic_reward_scale={model.intrinsic_reward_scale} with HerReplayBuffer: relabelled transitions get the "
            "environment's reward, without the bonus. Set intrinsic_reward_scale=0."
        )
    for name in sorted({"radius", "dynamics", "bf16"} & set(model.policy_kwargs)):
        remedy = (
            "it follows from norm_constraint, c_r, c_t and reward_range" if name == "radius" else f"pass {name} to BisimSAC"
        )
        raise ValueError(f"policy_kwargs with {name}={model.policy_kwargs[name]!r}: BisimSAC sets it; {remedy}.")
    if not (isinstance(model.policy_class, type) and issubclass(model.policy_class, BisimPolicy)):
        raise ValueError(f"policy={model.policy_class!r}: it must be a subclass of sb3_robust_bisim.policies.BisimPolicy.")
    if "features_extractor_class" not in model.policy_kwargs:
        _check_policy_fits(model)


def _check_policy_fits(model: "BisimSAC") -> None:
    """Each policy's own encoder reads one kind of observation."""
    name, space = model.policy_class.__name__, model.observation_space
    is_dict = isinstance(space, spaces.Dict)
    if is_dict != issubclass(model.policy_class, MultiInputPolicy):
        remedy = "use MultiInputPolicy for a Dict" if is_dict else "MultiInputPolicy is for a Dict, use MlpPolicy or CnnPolicy"
        raise ValueError(f"policy={name} with observations {space}: {remedy}.")
    if model.policy_class is MlpPolicy and is_image_space(space):
        raise ValueError(f'policy="MlpPolicy" with images {space}: use "CnnPolicy".')


def _is_number(value: Any, least: float = -np.inf) -> bool:
    return (
        isinstance(value, (int, float, np.number))
        and not isinstance(value, bool)
        and bool(np.isfinite(value) and value >= least)
    )


def _require(condition: Any, model: "BisimSAC", name: str, remedy: str) -> None:
    if not condition:
        raise ValueError(f"{name}={getattr(model, name)!r}: it must be {remedy}.")


def check_names(algorithm: type, kwargs: dict[str, Any]) -> None:
    """Refuse an argument that no class from ``algorithm`` to SAC has: a misspelt key must not train half a method."""
    lineage = algorithm.__mro__[: algorithm.__mro__.index(SAC) + 1]
    known = [name for cls in lineage for name in inspect.signature(cls).parameters]
    for name in kwargs:
        if name not in known:
            raise TypeError(f"BisimSAC has no argument {name!r} (value {kwargs[name]!r}){closest(name, known)}")


def closest(name: str, known: Iterable[str]) -> str:
    """The end of a message about a name that is not known."""
    matches = difflib.get_close_matches(name, known, n=1)
    return f", did you mean {matches[0]!r}?" if matches else ": see the documentation of BisimSAC and SAC."
