"""The trained agents that come with the package: small, without pickle, and as good as their cards say."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rl_zoo3.utils import EnvironmentName

from sb3_robust_bisim.cli.enjoy import TRAINED, trained_tasks
from sb3_robust_bisim.cli.zoo import main

CARTPOLE = "robust_bisim/SparseCartPole-v0"


@pytest.mark.parametrize("task", trained_tasks())
def test_an_agent_returns_what_its_card_says(task: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = TRAINED / EnvironmentName(task)
    assert sorted(path.name for path in folder.iterdir()) == ["README.md", "config.json", "task.yml", "weights.safetensors"]
    assert sum(path.stat().st_size for path in folder.iterdir()) < 1_000_000
    card = (folder / "README.md").read_text()
    (mean,) = re.findall(r"^\| return \| \*\*(\d+\.\d)\*\*", card, re.MULTILINE)
    for word in ("commit", "seed", "licence"):
        assert f"| {word} |" in card
    main(["enjoy", "--env", task, "--trained", "--no-render", "-n", "1000"])  # five episodes of 200 steps, or more and shorter
    played = capsys.readouterr().out
    assert float(re.findall(r"Mean reward: ([\d.]+)", played)[0]) > 0.9 * float(mean)


def test_a_video_of_it_needs_no_display_and_says_nothing_of_one(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sb3_robust_bisim", "enjoy", "--env", CARTPOLE, "--trained", "--video", "agent.gif"]
    headless = {
        key: value for key, value in os.environ.items() if key not in ("DISPLAY", "XDG_RUNTIME_DIR", "SDL_VIDEODRIVER")
    }
    headless["PYTHONPATH"] = str(TRAINED.parents[1])
    done = subprocess.run(command, cwd=tmp_path, env=headless, capture_output=True, text=True, timeout=300, check=True)
    assert "XDG" not in done.stderr
    assert "Agent: the one that comes with the package\n" in done.stdout
    assert (tmp_path / "agent.gif").exists()


def test_an_agent_that_the_package_does_not_have_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert trained_tasks() == [CARTPOLE]
    for arguments in (["--env", "Pendulum-v1"], [], ["--env", CARTPOLE, "--algo", "sac"]):
        with pytest.raises(SystemExit):
            main(["enjoy", "--trained", *arguments])
        assert f"--trained: the package has agents of bisim_sac for --env {CARTPOLE}" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["enjoy", "--trained", "--env", CARTPOLE, "-f", str(tmp_path)])
    assert "not allowed with argument" in capsys.readouterr().err
