"""The two files of an exported agent. They are written whole, and read without running anything that they contain."""

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import torch as th
from gymnasium import spaces
from safetensors.torch import load, save
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.utils import ConstantSchedule
from torch import nn, optim

from sb3_robust_bisim.encoders import CombinedEncoder, MlpEncoder, PixelEncoder
from sb3_robust_bisim.frame_buffer import FrameStackReplayBuffer
from sb3_robust_bisim.policies import POLICIES
from sb3_robust_bisim.runs.atomic import atomic_path

CONFIG, WEIGHTS = "config.json", "weights.safetensors"
FORMAT = 1
NOT_EXPORTED = "not exported"
DTYPES = ("uint8", "int8", "int16", "int32", "int64", "float16", "float32", "float64")
MOST_NUMBERS = 2**24  # of one space: a file of a few bytes must not fill the memory
# The parts of the file, and the JSON type of each
PARTS: dict[str, type] = {
    **{"format": int, "library": str, "policy": str, "observation_space": dict, "action_space": dict, "encoder": dict},
    **{"settings": dict, "num_timesteps": int, "n_updates": int, "weights_sha256": str},
}
PARTS_OF_ENCODER: dict[str, Any] = {
    **{"features_extractor_class": str, "features_extractor_kwargs": dict, "radius": (int, float, type(None))},
    **{"sphere": bool, "bf16": bool, "normalize_images": bool},
}


def _by_name(*classes: type) -> dict[str, type]:
    return {cls.__name__: cls for cls in classes}


# Settings that are classes. A file may only name these; it cannot make anything be imported
KNOWN_CLASSES: dict[str, Mapping[str, type]] = {
    "policy": POLICIES,
    "features_extractor_class": _by_name(
        *(MlpEncoder, PixelEncoder, CombinedEncoder, FlattenExtractor, NatureCNN, CombinedExtractor)
    ),
    "optimizer_class": _by_name(optim.Adam, optim.AdamW, optim.NAdam, optim.RAdam, optim.RMSprop, optim.SGD),
    "activation_fn": _by_name(nn.ReLU, nn.LeakyReLU, nn.ELU, nn.SELU, nn.GELU, nn.SiLU, nn.Mish, nn.Tanh, nn.Softplus),
    "replay_buffer_class": _by_name(ReplayBuffer, DictReplayBuffer, HerReplayBuffer, FrameStackReplayBuffer),
}


def write(folder: Path, config: dict[str, Any], weights: dict[str, th.Tensor]) -> None:
    """
    Write both files; existing ones are replaced. A reader notices if the two are not of the same export.

    :param config: the parts of ``config.json`` but format and checksum
    :param weights: without two names for the same memory
    """
    content = save({name: tensor.detach().cpu().contiguous() for name, tensor in weights.items()}, {"format": "pt"})
    config = {"format": FORMAT, **config, "weights_sha256": hashlib.sha256(content).hexdigest()}
    text = json.dumps(config, indent=2, allow_nan=False) + "\n"
    with atomic_path(folder / WEIGHTS) as temporary:
        temporary.write_bytes(content)
    with atomic_path(folder / CONFIG) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read(folder: Path) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """
    Read both files. The parts of the config have the right types; whatever they contain is not checked yet.

    :return: config and weights
    :raises FileNotFoundError: without one of the files
    :raises ValueError: for a file that is damaged, of another kind or of another export
    """
    for name in (CONFIG, WEIGHTS):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"{folder / name} does not exist: pass the folder that export_agent wrote.")
    config = _read_config(folder / CONFIG)
    file = folder / WEIGHTS
    content = file.read_bytes()
    try:
        weights = load(content)
    except (safetensors.SafetensorError, KeyError, ValueError, RuntimeError) as error:
        raise ValueError(f"{file} is not a whole safetensors file ({error}): get it again, or export again.") from error
    if hashlib.sha256(content).hexdigest() != config["weights_sha256"]:
        raise ValueError(f"{file} is not the file that {CONFIG} was written with: get both again, or export the agent again.")
    return config, weights


def _read_config(file: Path) -> dict[str, Any]:
    try:
        config = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} is not JSON ({error}): get it again, or export the agent again.") from error
    if not isinstance(config, dict) or config.get("format") != FORMAT:
        found = config.get("format") if isinstance(config, dict) else None
        raise ValueError(f"{file}: format={found!r}, this version reads {FORMAT}. Export the agent with this version.")
    _require_parts(config, PARTS, file)
    _require_parts(config["encoder"], PARTS_OF_ENCODER, file)
    return config


def _require_parts(found: dict[str, Any], parts: dict[str, Any], file: Path) -> None:
    if wrong := [name for name, kind in parts.items() if name not in found or not isinstance(found[name], kind)]:
        raise ValueError(f"{file}: {', '.join(wrong)} missing or of the wrong type. Get the file again, or export again.")
    if unknown := sorted(found.keys() - parts.keys()):
        raise ValueError(f"{file}: unknown {', '.join(unknown)}. Export the agent with this version.")


# --- settings


def settings_to_json(settings: dict[str, Any]) -> dict[str, Any]:
    """Classes become names, and numbers, texts, lists and dicts stay; anything else has to be passed when it is read."""
    return {name: _to_json(name, value) for name, value in settings.items()}


def _to_json(name: str, value: Any) -> Any:
    if name in KNOWN_CLASSES and isinstance(value, type):
        known = (known for known, cls in KNOWN_CLASSES[name].items() if cls is value)
        return next(known, f"{value.__module__}.{value.__qualname__}")
    if type(value) is ConstantSchedule:  # what rl-zoo3 makes of a learning rate
        value = value.val
    try:
        return _plain(value)
    except TypeError:
        return {NOT_EXPORTED: f"{type(value).__module__}.{type(value).__qualname__}"}


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if value is None or isinstance(value, (bool, int, str)) or (isinstance(value, float) and math.isfinite(value)):
        return value
    raise TypeError


def settings_from_json(settings: dict[str, Any], own: dict[str, Any], file: Path, argument: str) -> dict[str, Any]:
    """
    :param settings: as in the file
    :param own: what the caller passes, which replaces what the file says
    :param file: for the message
    :param argument: how the caller can pass what the file cannot contain, with a gap for "name=..."
    :raises ValueError: for a class that is not known, or a value that was not exported
    """
    found = dict(own)
    for name in settings.keys() - own.keys():
        value, known = settings[name], KNOWN_CLASSES.get(name, {})
        remedy = f"Pass {argument.format(f'{name}=...')}."
        if isinstance(value, dict) and NOT_EXPORTED in value:
            raise ValueError(f"{file}: {name} was a Python object ({value[NOT_EXPORTED]}), which is not exported. {remedy}")
        if known and value is not None and value not in list(known):
            raise ValueError(
                f"{file}: {name}={value!r} is not one of {', '.join(known)}, and no other class is imported. {remedy}"
            )
        found[name] = known[value] if known and value is not None else value
    return found


# --- spaces


def space_to_json(space: spaces.Space, name: str) -> dict[str, Any]:
    """
    :param name: of the space, for the message
    :raises ValueError: for a space that is no Box, Discrete or Dict of those
    """
    if type(space) is spaces.Box and space.dtype.name in DTYPES:
        bounds = {"low": _bound_to_json(space.low), "high": _bound_to_json(space.high)}
        return {"type": "Box", "shape": list(space.shape), "dtype": space.dtype.name, **bounds}
    if type(space) is spaces.Discrete:
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if type(space) is spaces.Dict and not any(isinstance(part, spaces.Dict) for part in space.values()):
        return {"type": "Dict", "spaces": {key: space_to_json(part, f"{name}[{key!r}]") for key, part in space.items()}}
    raise ValueError(f"{name} is {space}: only Box, Discrete and Dict of these can be exported. Wrap the environment.")


def _bound_to_json(bound: np.ndarray) -> list[Any]:
    """All values, or one for all. JSON has no infinities, so they are texts."""
    values = bound.ravel().tolist()
    values = values[:1] if len(set(values)) == 1 else values
    return [value if math.isfinite(value) else str(value) for value in values]


def space_from_json(description: dict[str, Any], file: Path) -> spaces.Space:
    """:raises ValueError: for anything that :func:`space_to_json` does not write"""
    try:
        return _space(description, nested=False)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, AssertionError) as error:
        text = str(description)
        raise ValueError(f"{file}: {text[:200]} is not a Box, Discrete or Dict of these ({error!r}). Export again.") from error


def _space(description: dict[str, Any], nested: bool) -> spaces.Space:
    if description["type"] == "Box":
        shape, dtype = tuple(map(int, description["shape"])), description["dtype"]
        if min(shape, default=1) < 1 or math.prod(shape) > MOST_NUMBERS or dtype not in DTYPES:
            raise ValueError(f"shape={shape}, dtype={dtype}: at least 1, at most {MOST_NUMBERS} numbers of a known kind")
        low, high = (_bound(description[name], shape, dtype) for name in ("low", "high"))
        return spaces.Box(low, high, dtype=np.dtype(dtype).type)
    if description["type"] == "Discrete":
        return spaces.Discrete(int(description["n"]), start=int(description["start"]))
    if description["type"] == "Dict" and not nested:
        # pairs keep their order, and the order is that of the features
        return spaces.Dict([(key, _space(part, nested=True)) for key, part in description["spaces"].items()])
    raise ValueError("unknown type")


def _bound(values: list[Any], shape: tuple[int, ...], dtype: str) -> np.ndarray:
    numbers = np.array([float(value) if isinstance(value, str) else value for value in values], dtype=dtype)
    return np.full(shape, numbers[0]) if len(numbers) == 1 else numbers.reshape(shape)


# --- weights


def weights_of(module: nn.Module) -> dict[str, th.Tensor]:
    """All parameters and buffers. What is reached in two ways has the first name only."""
    return {**dict(module.named_parameters()), **dict(module.named_buffers())}


def require_finite(weights: dict[str, th.Tensor], where: str) -> None:
    if broken := [name for name, tensor in weights.items() if not bool(tensor.isfinite().all())]:
        raise ValueError(f"{where}: {broken[0]} contains NaN or infinity. Its training has diverged: take an earlier agent.")


def fill(targets: dict[str, th.Tensor], weights: dict[str, th.Tensor], file: Path) -> None:
    """
    Copy weights, after all of them have been checked.

    :raises ValueError: for a tensor that is missing, unknown, of another shape or type, or not finite. float16 fits float32
    """
    remedy = f"{CONFIG} describes another agent, or another version of the library. Export the agent with this version."
    for what, names in (("missing", targets.keys() - weights.keys()), ("unknown", weights.keys() - targets.keys())):
        if names:
            raise ValueError(f"{file}: {len(names)} {what} tensors, such as {min(names)}. {remedy}")
    for name, target in targets.items():
        (shape, dtype), wanted = (tuple(weights[name].shape), weights[name].dtype), (tuple(target.shape), target.dtype)
        if dtype == th.float16 and target.dtype == th.float32:  # of a compact export
            dtype = th.float32
        if (shape, dtype) != wanted:
            raise ValueError(f"{file}: {name} has shape {shape} and {dtype}, where {wanted[0]} and {wanted[1]} fit. {remedy}")
    require_finite(weights, str(file))
    with th.no_grad():
        for name, target in targets.items():
            target.copy_(weights[name])
