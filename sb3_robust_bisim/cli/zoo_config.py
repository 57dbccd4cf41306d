"""rl-zoo3's config files for BisimSAC: the entries of tasks, named variants, and checks of their keys."""

import inspect
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3 import SAC

from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.checks import closest
from sb3_robust_bisim.cli.errors import UsageError

PACKAGE = Path(__file__).parents[1]
# A wheel has the configurations inside the package. In the repository they are next to it, also for an editable install.
FOLDERS = (PACKAGE / "zoo_configs", PACKAGE.parent / "zoo_configs")
DEFAULT_CONFIG = next((folder for folder in FOLDERS if folder.is_dir()), FOLDERS[0]) / "bisim_sac.yml"

# Keys that rl-zoo3 reads from an entry; the others are arguments of the algorithm
ZOO_KEYS = (
    *("callback", "env_kwargs", "env_wrapper", "eval_env_kwargs", "frame_stack", "monitor_kwargs", "n_envs"),
    *("n_timesteps", "noise_std", "noise_type", "normalize", "policy", "variants", "vec_env_wrapper"),
)
PASSED_BY_THE_ZOO = {"kwargs", "env", "seed", "verbose", "device", "tensorboard_log", "_init_setup_model"}


def merged_policy_kwargs(configured: dict[str, Any] | str, found: dict[str, Any]) -> dict[str, Any] | str:
    """
    Extend the policy_kwargs of a config file.

    :param configured: a mapping, or a Python expression as in most of rl-zoo3's files
    :param found: keys to add or to replace, with plain values
    :return: of the same kind; rl-zoo3 evaluates an expression
    """
    return f"{{**({configured}), **{found!r}}}" if isinstance(configured, str) else {**configured, **found}


def is_yaml(config: str | Path) -> bool:
    """True for YAML files; rl-zoo3 also accepts Python files and modules."""
    return Path(config).suffix in (".yml", ".yaml")


def variant_settings(config: str | Path, env_id: str, *names: str) -> dict[str, Any]:
    """
    Merge the settings of named variants, which override the entry of a task. Later names have priority.

    Mappings such as ``env_kwargs`` are extended key by key, not replaced.

    :param config: YAML file with a mapping ``variants``; the entry of the task may have another one, with priority
    :param env_id: the task
    :param names: variants, for example ("DBC",) or ("SAC", "clean", "small")
    :return: the keys that the variants set, to be laid over the entry
    :raises UsageError: if the file has no such variant
    """
    if not is_yaml(config):
        raise UsageError(f"-conf {config}: --variant needs a YAML file.")
    content = _read(config)
    entry = _entry(content, env_id)
    general, own = content.get("variants") or {}, entry.get("variants") or {}
    known = {**general, **own}
    settings: dict[str, Any] = {}
    for name in names:
        if name not in known:
            listed = ", ".join(known) or "no variants"
            raise UsageError(
                f"--variant {name}: no such variant{closest(name, known, '.')} For {env_id}, {config} has {listed}."
            )
        settings = _merged(_merged(settings, general.get(name, {})), own.get(name, {}))
    return {key: value for key, value in _merged(entry, settings).items() if key in settings}


def check_keys(hyperparams: dict[str, Any], source: str) -> None:
    """
    Raise an error for unknown keys, so a typo cannot silently disable part of the method.

    :param hyperparams: an entry of a config file for BisimSAC
    :param source: file or option, for the message
    :raises UsageError: with the key and the closest known one
    """
    known = {*ZOO_KEYS, *inspect.signature(BisimSAC).parameters, *inspect.signature(SAC).parameters} - PASSED_BY_THE_ZOO
    for key in hyperparams:
        if key not in known:
            raise UsageError(f"{source}: unknown key {key!r}{closest(key, known)}")


def check_task(env_id: str, config: str) -> None:
    """
    Raise an error for a task without an entry. rl-zoo3's own error does not list the tasks that have one.

    :param env_id: the task
    :param config: file with hyperparameters; only YAML files are checked
    :raises UsageError: with the tasks that have an entry
    """
    if not is_yaml(config):
        return
    tasks = [key for key in _read(config) if key != "variants"]
    if env_id not in tasks and "default" not in tasks:  # rl-zoo3 uses "default" for any task
        raise UsageError(
            f"--env {env_id}: {config} has settings for {', '.join(tasks)}. Copy the file, rename the entry of a similar "
            "task in the copy, set its reward_range, env_kwargs and eval_env_kwargs, and pass the copy with -conf."
        )


def entry_of(config: str, env_id: str) -> dict[str, Any]:
    """The settings of a task in a YAML file; empty if it has no entry."""
    return _entry(_read(config), env_id)


def _entry(content: dict[str, Any], env_id: str) -> dict[str, Any]:
    """As rl-zoo3 chooses it: the task's own entry, or that of any task."""
    return content.get(env_id, content.get("default", {}))


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """``above`` laid over ``below``; mappings that both have are merged as well."""
    both = {key: _merged(below[key], value) for key, value in above.items() if _are_mappings(value, below.get(key))}
    return {**below, **above, **both}


def _are_mappings(*values: Any) -> bool:
    return all(isinstance(value, dict) for value in values)


def _read(config: str | Path) -> dict[str, Any]:
    return yaml.safe_load(Path(config).read_text())
