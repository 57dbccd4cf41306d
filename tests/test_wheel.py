"""The wheel that a user installs works in a separate environment, away from the repository. It is built from the sdist."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TASK = "robust_bisim/SparseCartPole-v0"


def run(*command: str | Path, folder: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Paths of a virtual environment with the wheel. It also sees the installed packages, except editable installs."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"  # a copy, because building leaves files behind
    for name in ("sb3_robust_bisim", "zoo_configs", "tests"):
        shutil.copytree(ROOT / name, source / name)
    for path in ROOT.iterdir():
        if path.is_file():
            shutil.copy(path, source)
    build = "import setuptools.build_meta as backend; print(backend.build_sdist('.'))"
    sdist = source / run(sys.executable, "-c", build, folder=source).splitlines()[-1]

    venv.create(folder / "environment")
    base = str(folder / "environment")
    paths = {name: Path(path) for name, path in sysconfig.get_paths("venv", {"base": base, "platbase": base}).items()}
    here = {sysconfig.get_path(kind) for kind in ("purelib", "platlib")}
    (paths["purelib"] / "running.pth").write_text("\n".join(here))  # Python does not read the .pth files in there
    offline = ("--no-index", "--no-deps", "--no-build-isolation", "--disable-pip-version-check")
    run(paths["scripts"] / "python", "-m", "pip", "install", *offline, sdist, folder=folder)
    return paths


def test_the_wheel_contains_every_file_of_the_package_and_the_configurations(installed: dict[str, Path]) -> None:
    def files(folder: Path) -> set[str]:
        return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file() and path.suffix != ".pyc"}

    configurations = {str(Path("zoo_configs", name)) for name in files(ROOT / "zoo_configs")}
    assert files(installed["purelib"] / "sb3_robust_bisim") == files(ROOT / "sb3_robust_bisim") | configurations


def test_an_installed_package_trains_and_plays_in_an_empty_folder(installed: dict[str, Path], tmp_path: Path) -> None:
    train = ("train", "--env", TASK, "-n", "60", "--eval-freq", "-1", "-params", "learning_starts:50", "batch_size:8")
    output = run(installed["scripts"] / "python", "-m", "sb3_robust_bisim", *train, folder=tmp_path)
    config = installed["purelib"] / "sb3_robust_bisim" / "zoo_configs" / "bisim_sac.yml"
    assert f"Loading hyperparameters from: {config}" in output
    output = run(installed["scripts"] / "robust-bisim", "enjoy", "--env", TASK, "-n", "210", "--no-render", folder=tmp_path)
    assert "Episode Reward" in output
