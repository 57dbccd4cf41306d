"""What BisimSAC refuses before any work starts. Each message names the argument, its value and the remedy."""

import difflib
import inspect
import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.sac.sac import SAC

from sb3_robust_bisim.policies import BisimPolicy, MlpPolicy, MultiInputPolicy
from sb3_robust_bisim.values import is_number, is_whole

# The smallest value of each integer argument
LEAST = dict(policy_delay=1, initial_gradient_steps=0, batch_size=1, buffer_size=1, target_update_interval=1)


def check_arguments(model: Any) -> None:
    """
    :param model: a BisimSAC, as it is before its nets are built
    :raises ValueError: for an argument outside its range, or arguments that contradict each other
    """
    _require(isinstance(model.bf16, (bool, np.bool_)), model, "bf16", "True or False")
    for name, least in LEAST.items():
        _require(is_whole(getattr(model, name), least), model, name, f"an integer >= {least}")
    _require(is_whole(model.gradient_steps, -1), model, "gradient_steps", "an integer >= 0, or -1 for one per step")
    _require(is_number(model.learning_starts, 0), model, "learning_starts", "a number >= 0")
    _require(is_number(model.gamma, 0) and model.gamma <= 1, model, "gamma", "a number in [0, 1]")
    _require(is_number(model.tau, 0) and model.tau <= 1, model, "tau", "a number in [0, 1]")
    _check_train_freq(model)
    _check_entropy(model)
    _check_learning_rate(model)
    if model.bf16 and not has_bf16(model.device):
        unit = "GPU" if model.device.type == "cuda" else "CPU"
        warnings.warn(f"bf16=True: this {unit} has no bfloat16 instructions, so fp32 is several times faster.", stacklevel=4)
    _check_random_shift(model.random_shift, model.observation_space)
    n_steps = model.n_steps if model.n_steps != 1 else model.replay_buffer_kwargs.get("n_steps", 1)
    buffer_class = model.replay_buffer_class
    is_class = buffer_class is None or isinstance(buffer_class, type)
    _require(is_class, model, "replay_buffer_class", "a class, such as stable_baselines3.HerReplayBuffer, or None")
    if n_steps != 1 or (buffer_class is not None and issubclass(buffer_class, NStepReplayBuffer)):
        raise ValueError(
            f"n_steps={n_steps} (replay_buffer_class={buffer_class}): dynamics, inverse dynamics and metric are about one "
            "step. Use n_steps=1 and no NStepReplayBuffer."
        )
    if model.optimize_memory_usage:
        raise ValueError(
            "optimize_memory_usage=True: at the end of an episode SB3 then takes the start of the next one for the successor, "
            "and models and metric would learn it. Set it to False; FrameStackReplayBuffer saves memory for images."
        )
    absorbing = (model.metric_kwargs or {}).get("absorbing", False)
    if absorbing and not model.replay_buffer_kwargs.get("handle_timeout_termination", True):
        raise ValueError(
            "absorbing=True with handle_timeout_termination=False: time-outs would become absorbing states. Drop one of both."
        )
    if model.intrinsic_reward_scale > 0 and buffer_class is not None and issubclass(buffer_class, HerReplayBuffer):
        raise ValueError(
            f"intrinsic_reward_scale={model.intrinsic_reward_scale} with HerReplayBuffer: relabelled transitions get the "
            "environment's reward, without the bonus. Set intrinsic_reward_scale=0."
        )
    for name in sorted({"objective", "bf16", "random_shift"} & set(model.policy_kwargs)):
        remedy = "pass its settings to BisimSAC" if name == "objective" else f"pass {name} to BisimSAC"
        raise ValueError(f"policy_kwargs with {name}={model.policy_kwargs[name]!r}: BisimSAC sets it; {remedy}.")
    if not (isinstance(model.policy_class, type) and issubclass(model.policy_class, BisimPolicy)):
        raise ValueError(
            f"policy={model.policy_class!r}: it must be a subclass of sb3_robust_bisim.policies.BisimPolicy. "
            "Agents of SB3's SAC have another policy, so they cannot be loaded."
        )
    if "features_extractor_class" not in model.policy_kwargs:
        _check_policy_fits(model)


def _check_entropy(model: Any) -> None:
    auto, separator, start = model.ent_coef.partition("_") if isinstance(model.ent_coef, str) else ("", "", "")
    automatic = auto == "auto" and (not separator or _finite(start) > 0)
    remedy = 'a number >= 0, "auto", or "auto_" and a start above 0, such as "auto_0.1"'
    _require(automatic or _finite(model.ent_coef) >= 0, model, "ent_coef", remedy)
    automatic = isinstance(model.target_entropy, str) and model.target_entropy == "auto"
    _require(automatic or _finite(model.target_entropy) > -np.inf, model, "target_entropy", 'a number or "auto"')


def _check_learning_rate(model: Any) -> None:
    value = model.learning_rate
    now = value(1.0) if callable(value) else value if isinstance(value, (int, float)) else None  # SB3 takes no others
    _require(_finite(now) >= 0, model, "learning_rate", "a number >= 0, or a function that returns one")


def _finite(value: Any) -> float:
    """What ``float`` makes of a value, as SB3 does; minus infinity for what is no finite number."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return -np.inf
    return number if np.isfinite(number) else -np.inf


def has_bf16(device: th.device) -> bool:
    """Whether a CPU or an NVIDIA GPU has bfloat16 instructions, which torch emulates otherwise. Of others it is assumed."""
    if device.type == "cpu":
        return getattr(th.ops.mkldnn, "_is_mkldnn_bf16_supported", bool)()
    return device.type != "cuda" or th.cuda.is_bf16_supported(including_emulation=False)


def _check_train_freq(model: Any) -> None:
    value = model.train_freq  # a TrainFreq in a loaded model
    count, unit = value if isinstance(value, tuple) and len(value) == 2 else (value, "step")
    unit = getattr(unit, "value", unit)
    valid = is_whole(count, 1) and unit in ("step", "episode")
    _require(valid, model, "train_freq", 'n, (n, "step") or (n, "episode"), with an integer n >= 1')
    if unit == "episode" and model.n_envs > 1:
        raise ValueError(
            f"train_freq={tuple(value)} with {model.n_envs} environments: their episodes end at different times. Use "
            '(n, "step"), or one environment.'
        )


def checked_env(env: Any, verbose: int) -> Any:
    """
    :param env: an environment, its id, or None
    :return: the environment, made if it was an id
    :raises ValueError: unless actions are a Box with bounds
    """
    env = maybe_make_env(env, verbose)
    space = getattr(env, "action_space", None)
    if space is None:
        return env
    if not isinstance(space, spaces.Box):
        raise ValueError(
            f"action_space={space}: BisimSAC needs continuous actions, a Box. For discrete ones use SB3's DQN or PPO."
        )
    if not (np.isfinite([space.low, space.high]).all() and (space.low < space.high).all()):
        raise ValueError(
            f"action_space={space}: SAC scales actions to [-1, 1], so all bounds must be finite, with low < high. Use "
            "gymnasium.wrappers.RescaleAction or correct the environment."
        )
    return env


def _check_random_shift(pad: Any, space: spaces.Space) -> None:
    if not is_whole(pad, 0):
        raise ValueError(f"random_shift={pad!r}: it must be an integer in [0, image size), 0 for none.")
    if pad > 0 and not is_image_space(space):
        raise ValueError(
            f"random_shift={pad} with observations of shape {space.shape}: it needs images of bytes. Set random_shift=0."
        )
    if pad > 0 and pad >= (size := sorted(space.shape or ())[1]):  # the smallest axis is the channels
        raise ValueError(f"random_shift={pad}: it must be an integer in [0, {size - 1}] for images {space.shape}.")


def _check_policy_fits(model: Any) -> None:
    """Each policy's own encoder reads one kind of observation."""
    name, space = model.policy_class.__name__, model.observation_space
    is_dict = isinstance(space, spaces.Dict)
    if is_dict != issubclass(model.policy_class, MultiInputPolicy):
        remedy = "use MultiInputPolicy for a Dict" if is_dict else "MultiInputPolicy is for a Dict, use MlpPolicy or CnnPolicy"
        raise ValueError(f"policy={name} with observations {space}: {remedy}.")
    if model.policy_class is MlpPolicy and is_image_space(space):
        raise ValueError(f'policy="MlpPolicy" with images {space}: use "CnnPolicy".')


def _require(condition: Any, model: Any, name: str, remedy: str) -> None:
    if not condition:
        raise ValueError(f"{name}={getattr(model, name)!r}: it must be {remedy}.")


def check_names(algorithm: type, kwargs: dict[str, Any], also: Iterable[str] = ()) -> None:
    """
    Refuse an argument that no class from ``algorithm`` to SAC has: a typo must not silently disable a part of the method.

    :param algorithm: BisimSAC or a subclass
    :param kwargs: the arguments
    :param also: names that are known besides
    """
    lineage = algorithm.__mro__[: algorithm.__mro__.index(SAC) + 1]
    known = [*also, *(name for cls in lineage for name in inspect.signature(cls).parameters)]
    for name in kwargs:
        if name not in known:
            raise TypeError(f"BisimSAC has no argument {name!r} (value {kwargs[name]!r}){closest(name, known)}")


def closest(name: str, known: Iterable[str], otherwise: str = ": see the documentation of BisimSAC and SAC.") -> str:
    """The end of a message about a name that is not known: names that contain it, or the closest one."""
    known = list(dict.fromkeys(known))
    containing = [other for other in known if name in other] if len(name) > 2 else []
    matches = difflib.get_close_matches(name, containing, cutoff=0) or difflib.get_close_matches(name, known, n=1)
    return f", did you mean {' or '.join(map(repr, matches))}?" if matches else otherwise
