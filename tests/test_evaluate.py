"""`robust-bisim evaluate` and `robust-bisim enjoy --video`, run as a user runs them."""

import csv
import re
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
import yaml
from PIL import Image
from rl_zoo3.utils import EnvironmentName

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.cli.agents import latest_run
from sb3_robust_bisim.cli.distractors import Noise, Scene, distractors_of
from sb3_robust_bisim.cli.record import write_video
from sb3_robust_bisim.cli.scores import Score
from sb3_robust_bisim.cli.zoo import main
from sb3_robust_bisim.cli.zoo_config import DEFAULT_CONFIG

CARTPOLE, PIXELS = "robust_bisim/SparseCartPole-v0", "robust_bisim/cartpole-swingup-pixels-v0"


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder with an agent that observes noise columns."""
    folder = str(tmp_path_factory.mktemp("logs"))
    common = ("-f", folder, "--eval-freq", "-1", "--seed", "0")
    state = ("--env-kwargs", "noise_multiplier:1", "theta_rew_fraction:0.5", "-n", "60")
    main(
        [
            "train",
            "--env",
            CARTPOLE,
            *common,
            *state,
            "-params",
            "learning_starts:50",
            "batch_size:8",
            "initial_gradient_steps:1",
        ]
    )
    return folder


@pytest.fixture(scope="module")
def pixel_logs(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder with an agent that was trained in front of noise. Its episodes have 10 steps."""
    pytest.importorskip("dm_control")
    folder = str(tmp_path_factory.mktemp("pixel_logs"))
    main(
        [
            *("train", "--env", PIXELS, "-f", folder, "--eval-freq", "-1", "-n", "22", "--seed", "0"),
            *("--env-kwargs", "distractor:'noise'", "action_repeat:100", "shadows:False"),
            *("-params", "learning_starts:20", "batch_size:4", "buffer_size:60", "n_envs:1", "initial_gradient_steps:0"),
        ]
    )
    return folder


def rows_of(out: Path) -> dict[str, dict[str, str]]:
    with (out / "evaluation.csv").open(newline="") as file:
        return {row["distractor"]: row for row in csv.DictReader(file)}


def returns_by_hand(logs: str, seed: int, n_episodes: int, **env_kwargs: Any) -> list[float]:
    model = BisimSAC.load(next(Path(logs).glob("*/*/robust_bisim-SparseCartPole-v0.zip")))
    env = gym.make(CARTPOLE, **env_kwargs)
    returns = []
    for episode in range(n_episodes):
        obs, _ = env.reset(seed=seed if episode == 0 else None)
        done, total = False, 0.0
        while not done:
            obs, reward, terminated, truncated, _ = env.step(model.predict(obs, deterministic=True)[0])
            done, total = terminated or truncated, total + float(reward)
        returns.append(total)
    return returns


def test_a_state_agent_plays_under_other_noise_in_its_own_task(
    logs: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    command = ["evaluate", "--env", CARTPOLE, "-f", logs, "--seed", "5", "--n-episodes", "3", "--n-states", "3", "--no-video"]
    main([*command, "--out", str(tmp_path), "--distractors", "training", "std=0.5+mean=3", "std=1.0"])
    assert "Distractors to play: 2." in (printed := capsys.readouterr().out)  # std=1.0 is that of the training
    assert "| std=1.0 | yes |" in printed
    rows = rows_of(tmp_path)
    task = {"noise_multiplier": 1, "theta_rew_fraction": 0.5}
    for name, noise in {"training": {}, "std=0.5+mean=3": {"noise_std": 0.5, "noise_mean": 3.0}}.items():
        returns = returns_by_hand(logs, 5, 3, **task, **noise)
        assert [float(number) for number in rows[name]["returns"].split()] == returns
        assert float(rows[name]["mean"]) == pytest.approx(np.mean(returns))
        assert float(rows[name]["std"]) == pytest.approx(np.std(returns, ddof=1))
        assert min(returns) <= float(rows[name]["low"]) <= float(rows[name]["high"]) <= max(returns)
        assert -1 <= float(rows[name]["denoising_factor"]) <= 1
    assert [row["seen"] for row in rows.values()] == ["True", "False"]

    # the user's arguments extend those of the training; without --out, the results are in the folder of the run
    main([*command, "--env-kwargs", "theta_rew_fraction:1.0", "--distractors", "clean"])
    (row,) = rows_of(next(Path(logs).glob("*/robust_bisim-SparseCartPole-v0_1")) / "evaluation").values()
    returns = returns_by_hand(logs, 5, 3, **{**task, "theta_rew_fraction": 1.0}, noise_std=0.0)
    assert [float(number) for number in row["returns"].split()] == returns
    assert row["denoising_factor"] == "nan"  # there is no noise
    assert "| clean | no |" in capsys.readouterr().out


def test_a_pixel_agent_gets_a_table_a_picture_and_videos_and_rows_are_not_played_twice(
    pixel_logs: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    command = ["evaluate", "--env", PIXELS, "-f", pixel_logs, "--n-episodes", "1", "--n-states", "3", "--out", str(tmp_path)]
    main([*command, "--distractors", "noise", "clean"])
    rows = rows_of(tmp_path)
    assert {name: row["seen"] for name, row in rows.items()} == {"noise": "True", "clean": "False"}
    assert [row["episodes"] for row in rows.values()] == ["1", "1"]
    assert -1 <= float(rows["noise"]["denoising_factor"]) <= 1
    assert np.isnan(float(rows["clean"]["denoising_factor"]))
    text = (tmp_path / "evaluation.md").read_text()
    assert f"| noise | yes | {float(rows['noise']['mean']):.1f} | – | – | 1 |" in text
    assert imageio.imread(tmp_path / "evaluation.png").shape[2] == 4
    # the two ends have a video each: with and without noise behind the cart
    (noise,), (clean,) = (list(tmp_path.glob(f"videos/{name}-*/agent.mp4")) for name in ("noise", "clean"))
    assert imageio.get_reader(noise).get_data(3).std() > imageio.get_reader(clean).get_data(3).std()

    changed = (tmp_path / "evaluation.csv").read_text().replace(rows["noise"]["returns"], "1234.5")
    (tmp_path / "evaluation.csv").write_text(changed)
    capsys.readouterr()
    main([*command, "--distractors", "training", "camera-easy", "--no-video"])
    assert "Distractors to play: 1. " in capsys.readouterr().out
    assert rows_of(tmp_path)["noise"]["mean"] == "1234.5"  # "training" has the same settings, so it was not played
    assert "| training | yes | 1234.5 |" in (tmp_path / "evaluation.md").read_text()
    assert rows_of(tmp_path).keys() == {"noise", "clean", "camera-easy"}

    main([*command, "--distractors", "noise", "--no-video", "--seed", "1"])  # other settings
    assert "1234.5" not in (tmp_path / "evaluation.md").read_text()
    assert "1234.5" in (tmp_path / "evaluation.csv").read_text()


def seconds_of_gif(path: Path) -> float:
    with Image.open(path) as gif:
        durations = []
        for i in range(gif.n_frames):
            gif.seek(i)
            durations.append(gif.info["duration"])
    return sum(durations) / 1000


@pytest.mark.parametrize("fps", [30, 40, 60])
def test_a_gif_plays_as_long_as_the_episode_lasted(fps: int, tmp_path: Path) -> None:
    frames = [np.full((8, 8, 3), i, dtype=np.uint8) for i in range(120)]
    write_video(tmp_path / "agent.gif", frames, fps)
    assert seconds_of_gif(tmp_path / "agent.gif") == pytest.approx(120 / fps)


def test_enjoy_writes_a_video_of_one_episode_of_a_state_agent(
    logs: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    enjoy = ["enjoy", "--env", CARTPOLE, "-f", logs, "--seed", "5", "--video"]
    for name in ("agent.gif", "new/agent.mp4"):
        main([*enjoy, str(tmp_path / name)])
    said = capsys.readouterr().out
    (returned,) = returns_by_hand(logs, 5, 1, noise_multiplier=1, theta_rew_fraction=0.5)
    assert f"return {returned:.2f}" in said
    video = imageio.get_reader(tmp_path / "new" / "agent.mp4")
    n_steps = video.count_frames()
    assert f"Episode: {n_steps} steps" in said
    assert video.get_meta_data()["fps"] == 50.0
    assert video.get_data(n_steps - 1).shape == (400, 600, 3)
    with Image.open(tmp_path / "agent.gif") as gif:
        assert gif.size == (600, 400)
        first = np.asarray(gif.convert("RGB"), dtype=float)
    assert np.abs(first - video.get_data(0)).mean() < 5  # the same picture
    assert seconds_of_gif(tmp_path / "agent.gif") == pytest.approx(n_steps / 50)
    assert not list(tmp_path.rglob(".*"))  # no temporary file is left


class Unseen(gym.Env):
    """A task that cannot be drawn."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, **_: Any) -> tuple[np.ndarray, dict]:
        return np.zeros(2, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        return np.zeros(2, np.float32), 0.0, True, False, {}


def test_evaluate_of_a_task_that_cannot_be_drawn_says_so_in_its_table(tmp_path: Path) -> None:
    gym.register("test/Unseen-v0", Unseen)
    content = yaml.safe_load(DEFAULT_CONFIG.read_text())
    content["test/Unseen-v0"] = {**content[CARTPOLE], "env_kwargs": {}, "eval_env_kwargs": {}}
    config = tmp_path / "config.yml"
    config.write_text(yaml.dump(content))
    settings = ("-params", "learning_starts:10", "batch_size:4", "initial_gradient_steps:1")
    common = ("--env", "test/Unseen-v0", "-f", str(tmp_path / "logs"))
    main(["train", *common, "-conf", str(config), "-n", "20", "--eval-freq", "-1", *settings])
    main(["evaluate", *common, "--out", str(tmp_path / "out"), "--n-episodes", "2"])
    text = (tmp_path / "out" / "evaluation.md").read_text()
    assert "Video: not recorded, " in text
    assert "render_mode" in text


def test_enjoy_writes_a_video_of_a_pixel_agent_in_front_of_its_background(pixel_logs: str, tmp_path: Path) -> None:
    enjoy = ["enjoy", "--env", PIXELS, "-f", pixel_logs, "--video"]
    main([*enjoy, str(tmp_path / "noise.mp4")])
    main([*enjoy, str(tmp_path / "clean.gif"), "--env-kwargs", "distractor:none"])
    noise = imageio.get_reader(tmp_path / "noise.mp4")
    assert noise.count_frames() == 10
    with Image.open(tmp_path / "clean.gif") as gif:
        assert noise.get_data(3).std() > np.asarray(gif.convert("RGB")).std()
    assert seconds_of_gif(tmp_path / "clean.gif") == pytest.approx(10.0)  # 100 control steps of 10 ms per frame


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--video", "agent.avi"], "--video agent.avi: unknown suffix '.avi', use .mp4 or .gif"),
        (["--video", "folder.gif"], "--video folder.gif: this is a folder"),
        (["--video", "agent.gif", "-n", "100"], "one episode of the deterministic policy, so it does not take -n 100"),
        (["--video", "agent.gif", "--seed", "-1"], "--seed -1: must be at least 0"),
        (["--video", "agent.mp4"], "--video imageio.v2 is missing: pip install sb3_robust_bisim[dmc]"),
        (["--exp-id", "77"], "--exp-id 77: .*_77 folder was not found. Pass the --folder, .* --trained plays"),
        (["--load-checkpoint", "9"], "--folder .*: No run of .* has an agent"),
        (["-f", "empty"], "--folder empty: No run of bisim_sac on robust_bisim/SparseCartPole-v0 has an agent. .* --trained"),
    ],
)
def test_enjoy_refuses_before_any_work(
    arguments: list[str],
    message: str,
    logs: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.gif").mkdir()
    monkeypatch.setitem(sys.modules, "imageio.v2", None)  # as if it were not installed, which a GIF does not need
    with pytest.raises(SystemExit):
        main(["enjoy", "--env", CARTPOLE, *([] if "-f" in arguments else ["-f", logs]), *arguments])
    assert re.search(message.replace("[", r"\["), capsys.readouterr().err)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.gif"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--distractors", "clean", "nois"], "--distractors nois: there is no 'nois' .* training, clean, std=NUMBER"),
        (["--distractors", "video-train"], "there is no 'video-train' for this task"),
        (["--distractors", "std=2+std=3"], "two parts of it set noise_std"),
        (["--distractors", "std=-1"], "--distractors std=-1: noise_std must be a finite number >= 0"),
        (["--env-kwargs", "noise_mean:1"], "--env-kwargs noise_mean:1: --distractors sets it"),
        (["--exp-id", "7"], "--exp-id 7: .*_7 folder was not found. Pass the --folder"),
        (["--algo", "sac"], "--folder .*No run of sac on .*SparseCartPole-v0 has an agent"),
        (["--load-best"], "--folder .*No run of bisim_sac on .*SparseCartPole-v0 has an agent"),
    ],
)
def test_bad_input_is_refused_before_any_work(logs: str, arguments: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        main(["evaluate", "--env", CARTPOLE, "-f", logs, "--out", str(tmp_path / "out"), *arguments])
    assert not (tmp_path / "out").exists()


def test_the_latest_run_is_one_that_has_the_agent(tmp_path: Path) -> None:
    for number, steps in ((1, 500), (2, 500), (3, 900)):
        run = tmp_path / "bisim_sac" / f"robust_bisim-SparseCartPole-v0_{number}"
        run.mkdir(parents=True)
        (run / f"rl_model_{steps}_steps.zip").touch()
    which = (str(tmp_path), "bisim_sac", EnvironmentName(CARTPOLE))
    assert [latest_run(*which, steps=steps) for steps in ("500", "900", "*", None)] == [2, 3, 3, 0]


@pytest.mark.parametrize(
    ("option", "value"), [("--n-episodes", "0"), ("--n-states", "1"), ("--seed", "-1"), ("--algo", "sax")]
)
def test_an_option_outside_its_range_is_refused(option: str, value: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", "--env", CARTPOLE, option, value])
    assert stop.value.code == 2
    assert f"{option} {value}: must be" in capsys.readouterr().err


def test_a_csv_file_of_something_else_is_not_overwritten(logs: str, tmp_path: Path) -> None:
    (tmp_path / "evaluation.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"evaluation\.csv: not a table of this command"):
        main(["evaluate", "--env", CARTPOLE, "-f", logs, "--out", str(tmp_path)])


def test_the_names_of_distractors_of_pixel_tasks(tmp_path: Path) -> None:
    scene = distractors_of(PIXELS, {"distractor": "video", "camera_distraction": "easy", "size": 20, "shadows": False}, {})
    assert isinstance(scene, Scene)
    assert len(scene.suggested) >= 10
    everything = {name: scene.env_kwargs(name) for name in scene.suggested}
    assert [name for name, env_kwargs in everything.items() if scene.seen(env_kwargs)] == ["training"]
    assert [name for name, env_kwargs in everything.items() if not scene.distracts(env_kwargs)] == ["clean"]
    assert all(env_kwargs["size"] == 20 and not env_kwargs["shadows"] for env_kwargs in everything.values())
    hard = everything["video-heldout+camera-hard+color-hard+dynamic"]
    assert (hard["distractor"], hard["split"], hard["dynamic"]) == ("video", "eval", True)
    assert (hard["camera_distraction"], hard["color_distraction"]) == ("hard", "hard")
    with pytest.raises(ValueError, match="dynamic=True moves camera and colours"):
        scene.env_kwargs("noise+dynamic")
    with pytest.raises(ValueError, match="two parts of it set camera_distraction"):
        scene.env_kwargs("training+camera-hard")

    # a single file cannot be held out; other files are not those of the training
    picture = tmp_path / "picture.png"
    imageio.imwrite(picture, np.zeros((20, 20, 3), np.uint8))
    trained = {"distractor": "images", "distractor_files": str(picture), "cache_dir": str(tmp_path / "cache")}
    scene = Scene(trained, {})
    assert scene.seen(scene.env_kwargs("images-train"))
    with pytest.raises(ValueError, match=r"--distractors video-heldout: .* none can be held out"):
        scene.env_kwargs("video-heldout")
    imageio.imwrite(tmp_path / "other.png", np.zeros((20, 20, 3), np.uint8))
    scene = Scene(trained, {"distractor_files": str(tmp_path / "*.png")})
    assert not scene.seen(scene.env_kwargs("images-train"))
    assert scene.env_kwargs("training")["distractor_files"] == str(picture)


def test_noise_that_a_part_does_not_set_is_that_of_the_training() -> None:
    noise = distractors_of(CARTPOLE, {"noise_multiplier": 2, "noise_std": 2.0, "noise_mean": 1.0}, {})
    assert isinstance(noise, Noise)
    assert noise.env_kwargs("mean=3") == {"noise_multiplier": 2, "noise_std": 2.0, "noise_mean": 3.0}
    assert noise.seen(noise.env_kwargs("std=2"))
    for env_id in (CARTPOLE, "Pendulum-v1"):  # without noise, there is nothing to replace
        assert distractors_of(env_id, {}, {}).suggested == ("training",)


def test_one_episode_has_no_interval_and_equal_returns_have_an_empty_one() -> None:
    about = (0.5, "env", "{}", 0, "agent.zip", "settings")
    assert np.isnan([*Score("clean", True, (3.0,), *about).interval, Score("clean", True, (3.0,), *about).std]).all()
    assert Score("clean", True, (3.0, 3.0), *about).interval == (3.0, 3.0)
