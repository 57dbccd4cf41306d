"""The distractors of `evaluate`: their names, and the arguments of an environment that they stand for."""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

from sb3_robust_bisim.cli.errors import UsageError
from sb3_robust_bisim.envs.distractors import DISTRACTORS, ClipDistractor, make_distractor
from sb3_robust_bisim.envs.noise import NoisyTask, check_noise
from sb3_robust_bisim.envs.pixels import PixelTask
from sb3_robust_bisim.envs.scene import SCALES, check_scene

EnvKwargs = Mapping[str, Any]

SPLITS = {"train": "train", "heldout": "eval"}  # end of a name, and the argument ``split``
FILES = ("distractor_files", "grayscale")  # of backgrounds from files
TRAINING = "training"


class Distractors(ABC):
    """
    The distractors that fit a task. A name is one part, or several parts joined by "+".

    :param trained: arguments of the environment that the agent was trained in
    :param given: arguments of the environment from the command line
    :raises UsageError: if ``given`` sets the distraction
    """

    defaults: ClassVar[EnvKwargs] = {}  # the arguments that are the distraction, with the environment's defaults
    given_allowed: tuple[str, ...] = ()  # those of them that the command line may set
    choices: tuple[str, ...]  # parts, for help and error messages
    suggested: tuple[str, ...]  # names

    def __init__(self, trained: EnvKwargs, given: EnvKwargs) -> None:
        self.trained, self.given = trained, given
        for key in given:
            if key in self.defaults and key not in self.given_allowed:
                raise UsageError(f"--env-kwargs {key}:{given[key]!r}: --distractors sets it, so pass the name of a distractor")

    def env_kwargs(self, name: str) -> dict[str, Any]:
        """
        :param name: a distractor
        :return: the arguments of the environment, of which only the distraction differs from the training
        :raises UsageError: for an unknown part, for parts that exclude each other, and if the task cannot have the distractor
        """
        parts: dict[str, Any] = {}
        for word in name.split("+"):
            part = self._part(word)
            if part is None:
                choices = ", ".join(self.choices)
                raise UsageError(f"--distractors {name}: there is no {word!r} for this task, only {choices}; + combines them")
            if twice := sorted(part.keys() & parts.keys()):
                raise UsageError(f"--distractors {name}: two parts of it set {twice[0]}; omit one of them")
            parts |= part
        task = {key: value for key, value in {**self.trained, **self.given}.items() if key not in self.defaults}
        distraction = self.distraction(self._complete(parts))
        try:
            self._check(distraction)
        except ValueError as error:
            raise UsageError(f"--distractors {name}: {error}") from error
        return {**task, **distraction}

    def distraction(self, env_kwargs: EnvKwargs) -> dict[str, Any]:
        """The values of the arguments that are the distraction. Equal distractions have equal values."""
        return {key: env_kwargs.get(key, default) for key, default in self.defaults.items()}

    def seen(self, env_kwargs: EnvKwargs) -> bool:
        """True if this is exactly the distraction of the training."""
        return self.distraction(env_kwargs) == self.distraction(self.trained)

    @abstractmethod
    def distracts(self, env_kwargs: EnvKwargs) -> bool:
        """True if one state can be observed in several ways, so a denoising factor exists."""

    @abstractmethod
    def _part(self, word: str) -> dict[str, Any] | None:
        """The arguments that a part sets; None if there is no such part."""

    def _complete(self, parts: dict[str, Any]) -> dict[str, Any]:
        """Add the arguments that no part sets, unless they have the environment's defaults."""
        return parts

    @abstractmethod
    def _check(self, distraction: EnvKwargs) -> None:
        """Raise the environment's ValueError for the distraction, without creating an environment."""


class NoDistractors(Distractors):
    """For a task whose distraction is unknown: the environment of the training."""

    choices = suggested = (TRAINING,)

    def distracts(self, env_kwargs: EnvKwargs) -> bool:
        return False

    def _part(self, word: str) -> dict[str, Any] | None:
        return {} if word == TRAINING else None

    def _check(self, distraction: EnvKwargs) -> None:
        pass


class Noise(Distractors):
    """
    Noise columns with another standard deviation or mean. Their number cannot change, because the agent needs all of them.
    Without a part, standard deviation and mean are those of the training.
    """

    defaults: ClassVar[EnvKwargs] = {"noise_std": 1.0, "noise_mean": 0.0}
    choices = (TRAINING, "clean", "std=NUMBER", "mean=NUMBER")
    suggested = (TRAINING, "clean", "std=0.5", "std=2", "std=4", "mean=1", "mean=2", "mean=4", "std=2+mean=1")

    def distracts(self, env_kwargs: EnvKwargs) -> bool:
        return self.distraction(env_kwargs)["noise_std"] > 0

    def _part(self, word: str) -> dict[str, Any] | None:
        if word == TRAINING:
            return {}
        if word == "clean":
            return {"noise_std": 0.0, "noise_mean": 0.0}
        key, _, number = word.partition("=")
        try:
            return {f"noise_{key}": float(number)} if key in ("std", "mean") else None
        except ValueError:
            return None

    def _complete(self, parts: dict[str, Any]) -> dict[str, Any]:
        return {**{key: self.trained[key] for key in self.defaults if key in self.trained}, **parts}

    def _check(self, distraction: EnvKwargs) -> None:
        check_noise(1, distraction["noise_std"], distraction["noise_mean"], False, 0)


class Scene(Distractors):
    """Backgrounds, camera and colours of a pixel task. What no part sets is normal, also if it was not in the training."""

    defaults: ClassVar[EnvKwargs] = {
        key: inspect.signature(PixelTask).parameters[key].default
        for key in ("distractor", "split", *FILES, "camera_distraction", "color_distraction", "dynamic")
    }
    given_allowed = FILES
    suggested = (
        *("clean", "video-train", "video-heldout", "images-heldout", "noise", "balls", "color"),
        *(f"{part}-{scale}" for part in ("camera", "color") for scale in SCALES),
        # as in the benchmark of the Distracting Control Suite
        *(f"video-heldout+camera-{scale}+color-{scale}+dynamic" for scale in SCALES),
        TRAINING,
    )

    def __init__(self, trained: EnvKwargs, given: EnvKwargs) -> None:
        super().__init__(trained, given)
        self._parts: dict[str, dict[str, Any]] = {"clean": {}}
        for name in DISTRACTORS:
            if _plays_files(name):
                self._parts |= {f"{name}-{end}": {"distractor": name, "split": split} for end, split in SPLITS.items()}
            elif name != "none":
                self._parts[name] = {"distractor": name}
        self._parts |= {f"{part}-{scale}": {f"{part}_distraction": scale} for part in ("camera", "color") for scale in SCALES}
        self._parts["dynamic"] = {"dynamic": True}
        usual = self.distraction(self.trained)
        files = FILES if _plays_files(usual["distractor"]) else ()
        self._parts[TRAINING] = {key: usual[key] for key in usual if usual[key] != self.defaults[key] or key in files}
        self.choices = tuple(self._parts)

    def distraction(self, env_kwargs: EnvKwargs) -> dict[str, Any]:
        found = super().distraction(env_kwargs)
        return (
            found if _plays_files(found["distractor"]) else {**found, **{key: self.defaults[key] for key in ("split", *FILES)}}
        )

    def distracts(self, env_kwargs: EnvKwargs) -> bool:
        return self.distraction(env_kwargs) != self.defaults

    def _part(self, word: str) -> dict[str, Any] | None:
        return self._parts.get(word)

    def _complete(self, parts: dict[str, Any]) -> dict[str, Any]:
        if not _plays_files(parts.get("distractor", "none")):
            return parts
        configured = {**self.trained, **self.given}
        return {**{key: configured[key] for key in FILES if key in configured}, **parts}

    def _check(self, distraction: EnvKwargs) -> None:
        check_scene(*(distraction[key] for key in ("camera_distraction", "color_distraction", "dynamic")))
        name, split, files, grayscale = (distraction[key] for key in ("distractor", "split", *FILES))
        configured = {"size": 84, "cache_dir": None, **self.trained, **self.given}
        make_distractor(name, configured["size"], files, split, grayscale=grayscale, cache_dir=configured["cache_dir"])


def distractors_of(env_id: str, trained: EnvKwargs, given: EnvKwargs) -> Distractors:
    """
    :param env_id: id of the task
    :param trained: see :class:`Distractors`
    :param given: see :class:`Distractors`
    :return: the distractors that fit the task
    """
    entry_point = gym.spec(env_id).entry_point
    creator = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    if creator is PixelTask:
        return Scene(trained, given)
    if isinstance(creator, NoisyTask) and {**trained, **given}.get("noise_multiplier", 0) > 0:
        return Noise(trained, given)
    return NoDistractors(trained, given)


def _plays_files(distractor: str) -> bool:
    kind = DISTRACTORS.get(distractor)
    return kind is not None and issubclass(kind, ClipDistractor)
