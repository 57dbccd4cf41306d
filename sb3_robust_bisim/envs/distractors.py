"""Pictures that replace the background and are irrelevant to the task."""

from abc import abstractmethod
from functools import partial
from typing import Any

import numpy as np

from sb3_robust_bisim.envs.random_sequence import RandomSequence
from sb3_robust_bisim.envs.video import SplitClipFiles, check_split, load_clip, split_clips


class Distractor(RandomSequence):
    """
    A sequence of background pictures. A new kind is one subclass with this argument (or a subclass of :class:`ClipDistractor`,
    which takes files) and one entry of :data:`DISTRACTORS`.

    :param size: height and width of the pictures in pixels
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self._shape = (size, size, 3)

    @property
    @abstractmethod
    def frame(self) -> np.ndarray:
        """The current picture: uint8 array of shape (size, size, 3). Do not write to it."""


class ColorDistractor(Distractor):
    """
    One colour per episode, uniformly distributed.

    :param size: height and width of the pictures in pixels
    """

    def __init__(self, size: int) -> None:
        super().__init__(size)
        self._frame = np.zeros(self._shape, dtype=np.uint8)

    def paint(self, color: np.ndarray) -> None:
        """
        Show a colour until the next episode.

        :param color: red, green and blue: uint8 array of shape (3,)
        """
        self._frame = np.broadcast_to(color, self._shape).copy()

    def reset(self) -> None:
        self.paint(self._rng.integers(0, 256, 3, dtype=np.uint8))

    def step(self) -> None:
        pass

    @property
    def frame(self) -> np.ndarray:
        return self._frame


class NoiseDistractor(Distractor):
    """
    Gaussian noise, new at every step: clip(255 N(0, 1), 0, 255) in every channel of every pixel, as strong as in the
    literature. Half of the values are 0 and one in six is 255; the mean is 80.

    :param size: height and width of the pictures in pixels
    """

    def __init__(self, size: int) -> None:
        super().__init__(size)
        self._frame = np.zeros(self._shape, dtype=np.uint8)

    def reset(self) -> None:
        noise = self._rng.standard_normal(self._shape, dtype=np.float32)
        self._frame = np.clip(255.0 * noise, 0, 255).astype(np.uint8)

    def step(self) -> None:
        self.reset()

    @property
    def frame(self) -> np.ndarray:
        return self._frame


class ClipDistractor(Distractor):
    """
    Video from files: each episode plays a random clip in a loop, starting at a random frame.

    :param size: height and width of the pictures in pixels
    :param files: see :func:`~sb3_robust_bisim.envs.video.split_clips`; the files of both splits are decoded immediately
    :param split: "train" or "eval": the files to play
    :param grayscale: play without colour
    :param cache_dir: see :func:`~sb3_robust_bisim.envs.video.cache_folder`
    :raises ValueError: for an argument outside its range, or a file that is missing, empty or broken
    """

    def __init__(
        self,
        size: int,
        files: SplitClipFiles | None = None,
        split: str = "train",
        *,
        grayscale: bool = False,
        cache_dir: str | None = None,
    ) -> None:
        super().__init__(size)
        check_split(split)
        paths = split_clips(files)
        if not paths[split]:
            raise ValueError(
                f"distractor_files holds only the file {str(paths['train'][0])!r}, so none can be held out for split='eval'; "
                "add a second one, or pass a mapping {'train': ..., 'eval': ...}"
            )
        # Load both splits, so that a broken file is found before the evaluation
        everything = [*paths["train"], *paths["eval"]]
        self._load = partial(load_clip, size=size, grayscale=grayscale, cache_dir=cache_dir)
        clips = {path: self._load(path) for path in everything}
        self.paths = paths[split]
        self._clips = [clips[path] for path in self.paths]
        self._clip = 0
        self._position = 0

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_clips": None}  # they are in the cache

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._clips = [self._load(path) for path in self.paths]

    def reset(self) -> None:
        self._clip = int(self._rng.integers(len(self._clips)))
        self._position = int(self._rng.integers(len(self._clips[self._clip])))

    def step(self) -> None:
        self._position = (self._position + 1) % len(self._clips[self._clip])

    @property
    def frame(self) -> np.ndarray:
        frame = self._clips[self._clip][self._position]
        return frame if frame.ndim == 3 else np.broadcast_to(frame[..., None], self._shape)


class ImageDistractor(ClipDistractor):
    """
    Still images: each episode shows a random frame of a random file. A file can be a video or a picture.

    The arguments are those of :class:`ClipDistractor`.
    """

    def step(self) -> None:
        pass


class BallsDistractor(Distractor):
    """
    Coloured balls on black that attract each other and bounce off the edges of the picture (an n-body simulation).

    The picture is a unit square. Masses are proportional to the squared radius. The balls pass through each other.

    :param size: height and width of the pictures in pixels
    :param count: number of balls
    """

    _radius_range = (0.06, 0.14)  # in widths of the picture
    _start_speed = 0.02  # standard deviation of each component, in widths per step
    _gravity = 4e-4  # acceleration at distance 1 per unit of mass, in widths per step^2
    _softening = 0.1  # distance, in widths, below which the attraction fades, because balls are not points

    def __init__(self, size: int, count: int = 8) -> None:
        super().__init__(size)
        self._pixels = (np.arange(size) + 0.5) / size
        self._centers = np.zeros((count, 2))
        self._velocities = np.zeros((count, 2))
        self._radii = np.zeros(count)
        self._colors = np.zeros((count, 3), dtype=np.uint8)

    def reset(self) -> None:
        count = len(self._radii)
        self._radii = self._rng.uniform(*self._radius_range, count)
        self._centers = self._rng.uniform(self._radii[:, None], 1 - self._radii[:, None], (count, 2))
        self._velocities = self._rng.normal(0.0, self._start_speed, (count, 2))
        self._colors = self._rng.integers(48, 256, (count, 3), dtype=np.uint8)

    def step(self) -> None:
        offsets = self._centers[None] - self._centers[:, None]  # (i, j, xy): from ball i to ball j
        distances = np.sqrt((offsets**2).sum(-1) + self._softening**2)
        accelerations = (self._gravity * self._radii**2 / distances**3)[..., None] * offsets
        self._velocities += accelerations.sum(axis=1)
        self._centers += self._velocities
        low, high = self._radii[:, None], 1 - self._radii[:, None]
        inward = np.where(self._centers < low, 1.0, np.where(self._centers > high, -1.0, 0.0))
        self._velocities = np.where(inward == 0, self._velocities, inward * np.abs(self._velocities))
        self._centers = np.clip(self._centers, low, high)

    @property
    def frame(self) -> np.ndarray:
        frame = np.zeros(self._shape, dtype=np.uint8)
        squared = (self._pixels[None, :, None] - self._centers[:, None]) ** 2  # (ball, pixel, xy)
        inside = squared[:, None, :, 0] + squared[:, :, None, 1] < self._radii[:, None, None] ** 2
        for ball, color in zip(inside, self._colors, strict=True):
            frame[ball] = color
        return frame


# Values of the argument ``distractor`` of a task. Names, checks and error messages follow from this mapping.
DISTRACTORS: dict[str, type[Distractor] | None] = {
    "none": None,
    "color": ColorDistractor,
    "noise": NoiseDistractor,
    "images": ImageDistractor,
    "video": ClipDistractor,
    "balls": BallsDistractor,
}


def check_distractor(name: str, files: SplitClipFiles | None, split: str, grayscale: bool) -> None:
    """
    Check all arguments that can be checked without opening a file.

    :param name: a key of :data:`DISTRACTORS`
    :param files: see :class:`ClipDistractor`; only for distractors from files
    :param split: "train" or "eval"; ignored by distractors that take no files
    :param grayscale: see :class:`ClipDistractor`; only for distractors from files
    :raises ValueError: for an argument outside its range, or files or grayscale for a distractor that takes none
    """
    if name not in tuple(DISTRACTORS):
        raise ValueError(f"distractor must be one of {tuple(DISTRACTORS)}, got {name!r}")
    check_split(split)
    from_files = tuple(key for key, kind in DISTRACTORS.items() if kind is not None and issubclass(kind, ClipDistractor))
    if name in from_files:
        return
    for argument, value, default in (("distractor_files", files, None), ("grayscale", grayscale, False)):
        if value != default:
            raise ValueError(
                f"{argument} is only for the distractors {from_files}, got {value!r} for {name!r}: omit it, or choose one"
            )


def make_distractor(
    name: str,
    size: int,
    files: SplitClipFiles | None = None,
    split: str = "train",
    *,
    grayscale: bool = False,
    cache_dir: str | None = None,
) -> Distractor | None:
    """
    Create a distractor by name.

    :param name: a key of :data:`DISTRACTORS`
    :param size: height and width of the pictures in pixels
    :param files: see :class:`ClipDistractor`
    :param split: "train" or "eval"; ignored by distractors that take no files
    :param grayscale: see :class:`ClipDistractor`
    :param cache_dir: see :class:`ClipDistractor`
    :return: the distractor; None for "none"
    :raises ValueError: see :func:`check_distractor`; also for a file that is missing, empty or broken
    """
    check_distractor(name, files, split, grayscale)
    kind = DISTRACTORS[name]
    if kind is not None and issubclass(kind, ClipDistractor):
        return kind(size, files, split, grayscale=grayscale, cache_dir=cache_dir)
    return None if kind is None else kind(size)
