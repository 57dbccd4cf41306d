"""The documentation tells what the code does: its examples run, its commands exist, its tables name what there is."""

import inspect
import re
import shlex
import warnings
from collections.abc import Iterator
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import pytest
import yaml
from small_models import EVERYTHING, SMALL
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from sybil import Example, Sybil
from sybil.parsers.myst import CodeBlockParser
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_robust_bisim import BisimSAC, IntrinsicRewardVecEnv
from sb3_robust_bisim.callbacks import DenoisingFactorCallback, EmbeddingCallback, ValueBoundCallback
from sb3_robust_bisim.cli.zoo import COMMANDS, main
from sb3_robust_bisim.envs import classic, dmc, pixels
from sb3_robust_bisim.envs.distractors import DISTRACTORS
from sb3_robust_bisim.envs.noise import NoisyTask
from sb3_robust_bisim.losses import DISTANCES

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
# What shortens an example: it is replaced in the text before the example runs. Everything else runs as it stands
SHORTER = {
    r"learn\([\d_]+": "learn(40",
    r"learning_starts=[\d_]+": "learning_starts=30",
    r"initial_gradient_steps=[\d_]+": "initial_gradient_steps=2",
    r"batch_size=[\d_]+": "batch_size=8",
    r"n_eval_episodes=[\d_]+": "n_eval_episodes=1",
    r"n_envs=[\d_]+": "n_envs=2",
    r"every=[\d_]+": "every=16",
    r"eval_freq=[\d_]+": "eval_freq=32",
    r'"video", "split": "eval"': '"video", "split": "eval", "action_repeat": 100',  # ten steps per episode
}


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def run_shortened(example: Example) -> None:
    source = str(example.parsed)
    for pattern, replacement in SHORTER.items():
        source = re.sub(pattern, replacement, source)
    lines_before = "\n" * (example.line + example.parsed.line_offset)  # so that a traceback shows the line of the page
    exec(compile(lines_before + source, example.path, "exec"), example.namespace)


@pytest.mark.parametrize(
    "page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: str(page.relative_to(ROOT))
)
def test_the_python_examples_of_a_page_run_in_order(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # a window without a display
    document = Sybil([CodeBlockParser("python", run_shortened)]).parse(page)
    with ExitStack() as as_before:
        for names in (DISTANCES, DISTRACTORS):  # an example may enter names of its own
            as_before.enter_context(patch.dict(names))
        as_before.enter_context(warnings.catch_warnings())
        examples = list(document.examples())
        assert len(examples) == len(blocks(page, "python"))
        for example in examples:
            example.evaluate()


def commands(page: Path) -> Iterator[list[str]]:
    """The words of each command of the shell blocks of a page, without comments."""
    for block in blocks(page, "bash"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words:
                yield words[: words.index("&")] if "&" in words else words


@cache
def flags_of(command: str) -> set[str]:
    """The options that the help of one of our commands names."""
    printed: list[str] = []
    with patch("sys.stdout.write", printed.append), pytest.raises(SystemExit):
        main([command, "--help"])
    return set(re.findall(r"(?<![\w-])--?[A-Za-z][\w-]*", "".join(printed)))


def check_cli(words: list[str]) -> None:
    command, *options = words
    assert command in COMMANDS
    flags = {word for word in options if re.match(r"--?[A-Za-z]", word)}
    assert flags <= flags_of(command), words
    assert options[options.index("--env") + 1] in gym.registry
    if "--variant" in options:
        following = options[options.index("--variant") + 1 :]
        names = following[: next((i for i, word in enumerate(following) if word.startswith("-")), None)]
        config = yaml.safe_load((ROOT / "zoo_configs" / "bisim_sac.yml").read_text())
        entry = config[options[options.index("--env") + 1]]
        assert set(names) <= {*config["variants"], *entry.get("variants", {})}, words


def check_script(words: list[str]) -> None:
    script, *options = words
    source = (ROOT / script).read_text()
    for word in options:
        if word.startswith("-"):
            assert f'"{word}"' in source, words
    if script == "benchmarks/reproduce.py":
        assert f'"{options[0]}": Figure(' in (ROOT / "benchmarks" / "_figures.py").read_text(), words


@pytest.mark.parametrize(
    "page", [page for page in PAGES if blocks(page, "bash")], ids=lambda page: str(page.relative_to(ROOT))
)
def test_the_commands_of_a_page_exist_and_so_do_their_options(page: Path) -> None:
    targets = re.findall(r"^([a-z0-9-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for words in commands(page):
        match words:
            case ["robust-bisim", *rest] | ["python", "-m", "sb3_robust_bisim", *rest]:
                check_cli(rest)
            case ["python", script, *rest]:
                check_script([script, *rest])
            case ["make", *names]:
                assert set(names) <= set(targets), words
            case _:
                assert words[0] in {"pip", "python3", ".", "tensorboard", "apt-get", "dask", "wait"}, words


def table(page: str, heading: str) -> list[list[str]]:
    """The cells of the rows of the tables below a heading, without the row of titles."""
    section = re.split(r"^## ", (ROOT / "docs" / page).read_text(), flags=re.MULTILINE)
    text = next(part for part in section if part.startswith(heading))
    rows = [line.strip("|").split(" | ") for line in text.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in row] for row in rows]


@pytest.mark.parametrize(
    ("page", "heading", "accepts"),
    [
        ("environments/sparse_cartpole.md", "Arguments", classic.SparseCartPoleEnv),
        ("environments/sparse_pendulum.md", "Arguments", classic.SparsePendulumEnv),
        ("environments/mountain_car.md", "Arguments", classic.MountainCarContinuousEnv),
        ("environments/dmc_state.md", "Arguments", dmc.StateTask),
        ("environments/dmc_pixels.md", "Arguments", pixels.PixelTask),
        ("tasks.md", "Noise", NoisyTask.__call__),
    ],
)
def test_a_table_of_arguments_names_all_of_them_with_their_defaults(page: str, heading: str, accepts: Any) -> None:
    documented = {name.strip("`"): default.strip("`") for name, default, *_ in table(page, heading)}
    parameters = inspect.signature(accepts).parameters.values()
    optional = {p.name: str(p.default) for p in parameters if p.default is not inspect.Parameter.empty}
    assert {name: default.strip('"') for name, default in documented.items()} == optional


class Successes(gym.Wrapper):
    """Tells at the end of each episode that it was a success."""

    def step(self, action: Any) -> Any:
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated, truncated, {**info, "is_success": True}


def test_the_page_of_logged_metrics_has_exactly_the_keys_of_a_run_with_everything_on(tmp_path: Path) -> None:
    task = dict(env_id="robust_bisim/SparseCartPole-v0", wrapper_class=Successes)
    task["env_kwargs"] = dict(noise_multiplier=1, theta_rew_fraction=1.0)  # the rewards of an episode differ
    venv = IntrinsicRewardVecEnv(make_vec_env(**task, seed=0))  # type: ignore[arg-type]
    noise = {"noise_mean": 1.0}
    callbacks = [
        EvalCallback(IntrinsicRewardVecEnv(make_vec_env(**task)), eval_freq=50, n_eval_episodes=1, verbose=0),  # type: ignore[arg-type]
        EmbeddingCallback(every=50, n_states=10),
        DenoisingFactorCallback(every=50, n_states=3, n_positives=1, eval_env_kwargs=noise),
        ValueBoundCallback(every=50, n_states=10),
    ]
    settings = {**SMALL, **EVERYTHING, "buffer_size": 1000, "use_sde": True}
    model = BisimSAC("MlpPolicy", venv, tensorboard_log=str(tmp_path), **settings)
    model.learn(120, callbacks, log_interval=1)
    model.logger.close()
    found = EventAccumulator(str(tmp_path / "BisimSAC_1"))
    found.Reload()
    tags = found.Tags()
    projector = {path.parent.name for path in tmp_path.rglob("tensors.tsv")}
    headings = ("Training", "Embedding and metric", "Rollout and evaluation", "Callbacks")
    documented = {row[0].strip("`") for heading in headings for row in table("logged_metrics.md", heading)}
    assert documented == {*tags["scalars"], *tags["images"], *projector}
