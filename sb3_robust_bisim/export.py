"""Agents as files that anyone can read safely: weights as safetensors, settings as JSON, no pickle."""

import inspect
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.sac.sac import SAC

from sb3_robust_bisim import agent_files
from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.checks import check_names

LOG_ENT_COEF = "log_ent_coef"
TARGET = "critic_target."
# Arguments about one process or one machine, and those that have a place of their own in the file
ELSEWHERE = {"policy", "env", "device", "seed", "verbose", "tensorboard_log", "stats_window_size", "_init_setup_model"}
SETTINGS = [
    name
    for cls in (SAC, BisimSAC)
    for name, parameter in inspect.signature(cls).parameters.items()
    if name not in ELSEWHERE and parameter.kind is not parameter.VAR_KEYWORD
]


def export_agent(model: BisimSAC, folder: str | Path, compact: bool = False) -> None:
    """
    Write an agent to ``weights.safetensors`` and ``config.json``. Reading them runs no code, so strangers can exchange them.

    They contain all weights and arguments. They do not contain optimizer states, replay buffer, environment, the statistics of
    VecNormalize or the seed. Of Python objects, such as a learning rate schedule or your own encoder class, they contain the
    name only, and loading asks for the object.

    :param model: the agent
    :param folder: is created if it does not exist. Both files are replaced if they exist
    :param compact: less than half of the size. Weights are float16, so actions differ from the third digit on. The target
        networks are left out and start as copies
    :raises TypeError: for a subclass of BisimSAC, which may have settings of its own
    :raises ValueError: for a space other than Box, Discrete or Dict of these, or weights that are not finite
    """
    if type(model) is not BisimSAC:
        raise TypeError(f"model is a {type(model).__name__}: export_agent writes BisimSAC itself. Use its save() instead.")
    normalize = model.get_vec_normalize_env()
    if normalize is not None and normalize.norm_obs:
        warnings.warn("VecNormalize is not exported: save it as well, or the agent cannot be used.", stacklevel=2)
    policy, encoder = model.policy, model.policy.critic.features_extractor
    settings = {name: getattr(model, name) for name in SETTINGS}
    frequency: Any = model.train_freq
    settings["train_freq"] = [frequency.frequency, frequency.unit.value]
    config = {
        "library": version("sb3_robust_bisim"),
        **agent_files.settings_to_json({"policy": model.policy_class}),
        "observation_space": agent_files.space_to_json(model.observation_space, "observation_space"),
        "action_space": agent_files.space_to_json(model.action_space, "action_space"),
        # what PretrainedEncoder needs, the policy's defaults included
        "encoder": agent_files.settings_to_json(
            {
                "features_extractor_class": type(encoder.extractor),
                "features_extractor_kwargs": policy.features_extractor_kwargs,
                "radius": encoder.radius,
                "sphere": encoder.sphere,
                "bf16": bool(encoder.bf16),
                "normalize_images": encoder.normalize_images,
            }
        ),
        "settings": agent_files.settings_to_json(settings)
        | {"policy_kwargs": agent_files.settings_to_json(model.policy_kwargs)},
        "num_timesteps": model.num_timesteps,
        "n_updates": model._n_updates,
    }
    weights = _weights_of(model)
    agent_files.require_finite(weights, "model")
    if compact:
        weights = {name: _half(name, tensor) for name, tensor in weights.items() if not name.startswith(TARGET)}
    agent_files.write(Path(folder), config, weights)


def load_agent(
    folder: str | Path, env: GymEnv | str | None = None, device: th.device | str = "auto", **kwargs: Any
) -> BisimSAC:
    """
    Bring back an agent that :func:`export_agent` wrote. Nothing in the files is executed or imported.

    It predicts the same actions and can be trained further. Optimizers start afresh and the replay buffer is empty, so
    training does not continue exactly; :func:`sb3_robust_bisim.runs.save_checkpoint` is for that.

    :param folder: with both files. A hostile file may make loading fail or take much memory, but no more than that
    :param env: environment for further training, or its id; for prediction only an agent with HerReplayBuffer needs it
    :param device: where the nets are
    :param kwargs: arguments of BisimSAC that replace the exported ones, ``policy`` and ``seed`` among them. ``policy_kwargs``
        replace those of the same name; pass your own classes there:
        ``policy_kwargs=dict(features_extractor_class=MyEncoder)``
    :raises FileNotFoundError: without one of the files
    :raises TypeError: for an argument that does not exist
    :raises ValueError: for a damaged or foreign file, an unknown class in it, weights that do not fit or are not finite, or
        other spaces than those of ``env``
    """
    check_names(BisimSAC, kwargs)
    folder = Path(folder)
    file = folder / agent_files.CONFIG
    config, weights = agent_files.read(folder)
    if unknown := sorted(config["settings"].keys() - set(SETTINGS)):
        raise ValueError(f"{file}: BisimSAC has no argument {unknown[0]!r}. Use version {config['library']} of the library.")
    if not isinstance(config["settings"].get("policy_kwargs"), dict):
        raise ValueError(f"{file}: policy_kwargs is no dict. Get the file again, or export again.")
    spaces = {name: agent_files.space_from_json(config[name], file) for name in ("observation_space", "action_space")}
    settings = _settings(config, kwargs, file)
    if env is None and issubclass(settings.get("replay_buffer_class") or object, HerReplayBuffer):
        raise ValueError("env=None: the agent's HerReplayBuffer computes rewards with its environment. Pass env.")
    model = BisimSAC(env=env, device=device, _init_setup_model=False, **settings)  # type: ignore[arg-type]  # as in SB3
    for name, space in spaces.items():
        if env is not None and getattr(model, name) != space:
            found = getattr(model, name)
            raise ValueError(f"env: its {name} is {found}, the agent in {folder} needs {space}. Pass such an env.")
        setattr(model, name, space)
    if env is None:
        model.n_envs = 1  # SB3 takes it from the environment, and the replay buffer needs it
    try:
        model._setup_model()
    except Exception as error:
        cause = f"{file}: no agent can be built from this and the arguments of load_agent ({error!r})"
        raise ValueError(f"{cause}. Check these arguments, or export the agent again.") from error
    targets = _weights_of(model)
    if "ent_coef" in kwargs:  # then the exported coefficient does not count
        weights.pop(LOG_ENT_COEF, None)
        targets.pop(LOG_ENT_COEF, None)
    compact = not any(name.startswith(TARGET) for name in weights)
    if compact:
        targets = {name: tensor for name, tensor in targets.items() if not name.startswith(TARGET)}
    agent_files.fill(targets, weights, folder / agent_files.WEIGHTS)
    if compact:
        model.critic_target.load_state_dict(model.critic.state_dict())
    if model.use_sde:
        model.policy.reset_noise()  # it was drawn with the weights from before
    model.num_timesteps, model._n_updates = config["num_timesteps"], config["n_updates"]
    return model


def _settings(config: dict[str, Any], kwargs: dict[str, Any], file: Path) -> dict[str, Any]:
    """The arguments of BisimSAC: those of the file, replaced by the caller's."""
    exported = {**config["settings"], "policy": config["policy"]}
    policy_kwargs = agent_files.settings_from_json(
        exported.pop("policy_kwargs"),
        kwargs.get("policy_kwargs") or {},
        file,
        "load_agent(..., policy_kwargs=dict({}))",
    )
    own = {**kwargs, "policy_kwargs": policy_kwargs}
    settings = agent_files.settings_from_json(exported, own, file, "load_agent(..., {})")
    if isinstance(settings.get("train_freq"), list):
        settings["train_freq"] = tuple(settings["train_freq"])  # SB3 takes no list
    return settings


def _weights_of(model: BisimSAC) -> dict[str, th.Tensor]:
    weights = agent_files.weights_of(model.policy)
    return weights if model.log_ent_coef is None else {**weights, LOG_ENT_COEF: model.log_ent_coef}


def _half(name: str, tensor: th.Tensor) -> th.Tensor:
    """:raises ValueError: if a number is too large for float16"""
    if tensor.dtype != th.float32:
        return tensor
    half = tensor.detach().half()
    if not bool(half.isfinite().all()):
        raise ValueError(f"compact=True: {name} has values above 65504, the largest float16. Export with compact=False.")
    return half
