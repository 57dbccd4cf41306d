"""What the zoo's config files hold for BisimSAC: entries of tasks, named variants, and keys that somebody reads."""

import inspect
from pathlib import Path
from typing import Any

import yaml
from rl_zoo3 import exp_manager
from stable_baselines3 import SAC

from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.checks import closest

# What an entry of a zoo YAML may hold beside the arguments of the algorithm
ZOO_KEYS = (
    *("callback", "env_kwargs", "env_wrapper", "eval_env_kwargs", "frame_stack", "monitor_kwargs", "n_envs"),
    *("n_timesteps", "noise_std", "noise_type", "normalize", "policy", "variants", "vec_env_wrapper"),
)
PASSED_BY_THE_ZOO = {"kwargs", "env", "seed", "verbose", "device", "tensorboard_log", "_init_setup_model"}


def policy_kwargs_of(settings: dict[str, Any]) -> dict[str, Any]:
    """Those of an entry, which may be a Python expression, as in most of the zoo's own files."""
    policy_kwargs = settings.get("policy_kwargs", {})
    return eval(policy_kwargs, vars(exp_manager)) if isinstance(policy_kwargs, str) else policy_kwargs


def is_yaml(config: str | Path) -> bool:
    """The zoo takes a Python module as well, which it imports."""
    return Path(config).suffix in (".yml", ".yaml")


def variant_settings(config: str | Path, env_id: str, *names: str) -> dict[str, Any]:
    """
    The settings that named variants of a config file lay over the entry of a task, the last one on top.

    :param config: YAML file with a mapping ``variants``, and perhaps another one inside the task's entry
    :param env_id: the task
    :param names: variants, ("DBC",) or ("SAC", "clean", "small") for example
    :raises ValueError: if the file knows no such variant
    """
    if not is_yaml(config):
        raise ValueError(f"-conf {config}: --variant needs a YAML file.")
    content = _read(config)
    general, own = content.get("variants") or {}, content.get(env_id, {}).get("variants") or {}
    settings: dict[str, Any] = {}
    for name in names:
        if name not in general and name not in own:
            raise ValueError(f"--variant {name}: for {env_id}, {config} has {', '.join({**general, **own}) or 'no variants'}.")
        settings |= {**general.get(name, {}), **own.get(name, {})}
    return settings


def check_keys(hyperparams: dict[str, Any], source: str) -> None:
    """
    Refuse keys that nobody would read, before a run folder exists.

    :param hyperparams: an entry of a config file for BisimSAC
    :param source: file name, for the message
    :raises ValueError: naming the key and the closest known one
    """
    known = {*ZOO_KEYS, *inspect.signature(BisimSAC).parameters, *inspect.signature(SAC).parameters} - PASSED_BY_THE_ZOO
    for key in hyperparams:
        if key not in known:
            raise ValueError(f"{source}: unknown key {key!r}{closest(key, known)}")


def check_task(env_id: str, config: str) -> None:
    """
    Refuse a task without an entry, for the zoo does not say which there are.

    :param env_id: the task
    :param config: file of hyperparameters; only a YAML file can be looked into
    :raises ValueError: naming the tasks that have one
    """
    if not is_yaml(config):
        return
    tasks = [key for key in _read(config) if key != "variants"]
    if env_id not in tasks and "default" not in tasks:  # the zoo's entry for any task
        raise ValueError(
            f"--env {env_id}: {config} has settings for {', '.join(tasks)}. Copy the entry of a task that is like yours, in "
            "this file or in one of your own, which -conf names."
        )


def entry_of(config: str, env_id: str) -> dict[str, Any]:
    """The settings of a task in a YAML file; none if it has no entry of its own."""
    return _read(config).get(env_id, {})


def _read(config: str | Path) -> dict[str, Any]:
    return yaml.safe_load(Path(config).read_text())
