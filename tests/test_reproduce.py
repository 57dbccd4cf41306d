"""The sweep that repeats the paper's figures runs in real processes and survives real kills."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack

from sb3_robust_bisim import BisimSAC

pytestmark = pytest.mark.xdist_group("sweeps")  # they share the local sweep and use both cores

ROOT = Path(__file__).parent.parent
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}


def reproduce(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(command(folder, *arguments), env=ENVIRONMENT, capture_output=True, text=True, timeout=600)


def command(folder: Path, *arguments: str) -> list[str]:
    places = ["--out", str(folder / "results"), "--work", str(folder / "work")]
    return [sys.executable, str(ROOT / "benchmarks/reproduce.py"), *arguments, *places]


SWEEP = [
    *("cartpole", "--panels", "N_m=2", "--methods", "SAC", "normed-IR-ID", "--seeds", "3", "--steps", "400"),
    *("--eval-freq", "100", "--params", "learning_starts:100", "initial_gradient_steps:20", "batch_size:32"),
]


def results(folder: Path) -> dict[str, dict]:
    return {path.stem: json.loads(path.read_text()) for path in folder.glob("results/*/*.json")}


@contextmanager
def started(*arguments: str) -> Iterator[subprocess.Popen]:
    process = subprocess.Popen([sys.executable, *arguments], env=ENVIRONMENT, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextmanager
def dask_cluster() -> Iterator[tuple[str, list[subprocess.Popen]]]:
    """A scheduler and two workers in three separate processes."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    host, port = address.split(":")
    worker = ("-m", "dask", "worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
    with (
        started("-m", "dask", "scheduler", "--host", host, "--port", port, "--no-dashboard"),
        started(*worker) as first,
        started(*worker) as second,
    ):
        yield address, [first, second]


def wait_until(condition: Callable[[], Any], process: subprocess.Popen, seconds: float = 300) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, "the sweep ended too early"
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six runs on this machine, undisturbed."""
    folder = tmp_path_factory.mktemp("local")
    process = reproduce(folder, *SWEEP, "--jobs", "2")
    assert process.returncode == 0, process.stderr
    assert json.loads(process.stdout.splitlines()[-1])["runs"] == 6
    return folder


def test_a_sweep_on_dask_survives_a_killed_worker_and_gives_the_same_numbers_as_a_local_sweep(local, tmp_path) -> None:
    with dask_cluster() as (address, workers):
        arguments = command(tmp_path, *SWEEP, "--backend", "dask", "--scheduler", address)
        with subprocess.Popen(arguments, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            # both workers are in the middle of a run and have written a checkpoint
            wait_until(lambda: len(list(tmp_path.glob("work/*/*/checkpoint.pkl"))) == 2, process)
            workers[0].send_signal(signal.SIGKILL)
            assert process.wait(timeout=600) == 0
    expected, found = results(local), results(tmp_path)
    assert {name: run["evaluations"] for name, run in found.items()} == {
        name: run["evaluations"] for name, run in expected.items()
    }
    assert len(found) == 6
    logs = [path.read_text() for path in tmp_path.glob("work/*/*/log.txt")]
    assert sum("Going on from step" in log for log in logs) == 1
    assert all(log.count("Saving to") == 1 for log in logs)


def test_a_killed_sweep_resumes_and_ends_with_the_same_numbers(local, tmp_path) -> None:
    arguments = command(tmp_path, *SWEEP, "--jobs", "2")
    with subprocess.Popen(arguments, env=ENVIRONMENT, stderr=subprocess.DEVNULL, start_new_session=True) as process:
        wait_until(lambda: results(tmp_path) and list(tmp_path.glob("work/*/*/checkpoint.pkl")), process)
        os.killpg(process.pid, signal.SIGKILL)
    ended = {path: path.stat().st_mtime_ns for path in tmp_path.glob("results/*/*.json")}
    assert 1 <= len(ended) < 6
    assert reproduce(tmp_path, *SWEEP, "--jobs", "2").returncode == 0
    assert {name: run["evaluations"] for name, run in results(tmp_path).items()} == {
        name: run["evaluations"] for name, run in results(local).items()
    }
    assert {path: path.stat().st_mtime_ns for path in ended} == ended, "a finished run was run again"
    assert any("Going on from step" in path.read_text() for path in tmp_path.glob("work/*/*/log.txt"))


def test_a_finished_sweep_has_curves_a_csv_a_table_and_no_runs_left(local) -> None:
    (folder,) = (local / "results").iterdir()
    assert folder.name == "cartpole_400steps_every100_batch_size=32_initial_gradient_steps=20_learning_starts=100"
    assert (folder / "curves.png").read_bytes().startswith(b"\x89PNG")
    curves = (folder / "curves.csv").read_text()
    assert "mean_return,N_m=2,normed-IR-ID,3,400," in curves
    assert "iqm_return" not in curves  # for three runs it would equal the mean
    assert "| N_m=2 | normed-IR-ID | 3 |" in (folder / "table.md").read_text()
    process = reproduce(local, *SWEEP, "--dry-run")
    assert process.stdout == ""
    assert process.stderr.startswith("6 of 6 runs have ended")


def test_a_dry_run_shows_the_commands_and_the_time_and_runs_nothing(tmp_path) -> None:
    process = reproduce(tmp_path, *SWEEP, "--dry-run")
    commands = process.stdout.splitlines()
    assert len(commands) == 6
    assert not (tmp_path / "work").exists()
    assert "--variant SAC" in commands[0]
    assert "--device cpu" in commands[0]
    assert "0 of 6 runs have ended; the rest takes" in process.stderr


def test_results_elsewhere_come_from_runs_elsewhere(tmp_path) -> None:
    command = [sys.executable, str(ROOT / "benchmarks/reproduce.py"), *SWEEP, "--dry-run", "--out", "again"]
    process = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=600, check=True)
    runs = Path("again") / "work"
    assert all(f"--log-folder {runs}{os.sep}" in line for line in process.stdout.splitlines())


def test_a_run_shared_by_two_figures_is_run_once(tmp_path) -> None:
    recorded = sorted(ROOT.glob("benchmarks/results/cartpole/N_m2_DBC_seed*.json"))
    (tmp_path / "results" / "cartpole").mkdir(parents=True)
    for path in recorded:
        shutil.copy(path, tmp_path / "results" / "cartpole")
    assert len(recorded) >= 5
    process = reproduce(tmp_path, "dbc_alt", "--panels", "N_m=2", "--dry-run")
    assert process.stderr.startswith("5 of 10 runs have ended")
    assert all("--variant DBC-alt" in command for command in process.stdout.splitlines())
    assert reproduce(tmp_path, "dbc_alt", "--only-draw").returncode == 0
    assert "| N_m=2 | DBC | 5 |" in (tmp_path / "results" / "dbc_alt" / "table.md").read_text()


def test_results_of_another_configuration_are_refused(tmp_path) -> None:
    recorded = json.loads((ROOT / "benchmarks/results/cartpole/N_m2_SAC_seed0.json").read_text())
    path = tmp_path / "results" / "cartpole" / "N_m2_SAC_seed0.json"
    path.parent.mkdir(parents=True)
    recorded["arguments"]["intrinsic_reward_max"] = 0.1  # stating a default changes nothing
    path.write_text(json.dumps(recorded))
    assert reproduce(tmp_path, "cartpole", "--dry-run").returncode == 0
    recorded["arguments"]["batch_size"] = 64
    path.write_text(json.dumps(recorded))
    process = reproduce(tmp_path, "cartpole")
    assert process.returncode == 1
    assert (
        "N_m2_SAC_seed0.json was made with other settings: batch_size is 64 there and 512 in bisim_sac.yml" in process.stderr
    )
    assert not (tmp_path / "work").exists()


def test_results_that_could_not_be_drawn_afterwards_are_refused_before_the_sweep(tmp_path) -> None:
    recorded = json.loads((ROOT / "benchmarks/results/cartpole/N_m2_SAC_seed1.json").read_text())
    recorded["arguments"]["batch_size"] = 64
    path = tmp_path / "results" / "cartpole" / "N_m2_SAC_seed1.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(recorded))
    process = reproduce(tmp_path, "cartpole", "--seeds", "1", "--methods", "DBC")
    assert process.returncode == 1
    assert "N_m2_SAC_seed1.json was made with other settings" in process.stderr
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize(
    ("text", "value"),
    [("1e-3", 0.001), ("128", 128), ("auto_0.1", "auto_0.1"), ("l1", "l1"), ("null", None), ("[3, 2]", [3, 2])],
)
def test_a_setting_is_read_as_yaml_and_1e_3_as_a_number(text: str, value: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from reproduce import setting

    key, read = setting(f"learning_rate:{text}")
    assert (key, read, type(read)) == ("learning_rate", value, type(value))


def test_a_run_that_moves_names_both_machines_and_their_versions(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from reproduce import begin

    gpu = {"commit": "a", "machine": "GPU", "versions": {"torch": "2.11", "numpy": "2.4"}}
    cpu = {**gpu, "machine": "CPU", "versions": {"torch": "2.13", "numpy": "2.4"}}
    (tmp_path / "run").mkdir()
    assert begin(tmp_path / "run", gpu) == gpu
    (tmp_path / "run" / "trained.json").touch()
    moved = {"commit": "a", "machine": "GPU, then CPU", "versions": {"torch": "2.11, then 2.13", "numpy": "2.4"}}
    for _ in range(2):  # the second time it has not moved
        assert begin(tmp_path / "run", cpu) == moved


def test_no_run_waits_for_another_seed_of_its_method(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from reproduce import train

    for seed in ("seed0", "seed1"):
        name = f"N_m1_normed-IR-max0.1_{seed}"
        (tmp_path / f"{name}.json").write_text(json.dumps({"seed": seed}))
        train([], tmp_path / "work" / name, tmp_path / f"{name}.json", {"seed": seed}, "a commit", ())
    assert len(list(tmp_path.glob("work/*.lock"))) == 2


def test_the_final_agents_of_all_seeds_play_the_same_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from reproduce import play

    task = "robust_bisim/cartpole-swingup-pixels-v0"
    settings = dict(distractor="video", size=16, action_repeat=40)
    venv = VecFrameStack(make_vec_env(task, 1, env_kwargs=settings), n_stack=3)
    model = BisimSAC("CnnPolicy", venv, buffer_size=10, seed=0)
    returns = []
    for seed in (0, 1):
        run = tmp_path / str(seed) / "bisim_sac" / "robust_bisim-cartpole-swingup-pixels-v0_1"
        (run / "task").mkdir(parents=True)
        (run / "task" / "config.yml").write_text(yaml.dump({"env_kwargs": settings}))
        model.seed = seed
        model.save(run / "robust_bisim-cartpole-swingup-pixels-v0")
        returns.append(play(tmp_path / str(seed), {"env": task}, "eval", n_episodes=2))
    assert returns[0] == returns[1]


def test_a_run_that_broke_off_does_not_hide_the_other_runs(tmp_path) -> None:
    folder = shutil.copytree(ROOT / "benchmarks/results/dmc_pixels", tmp_path / "results/dmc_pixels")
    recorded = json.loads((folder / "video_self-prediction-shift_seed0.json").read_text())
    broken = {**recorded, "seed": 1, "stopped": "train/critic_loss became nan"}
    del broken["final_return_by_split"]
    (folder / "video_self-prediction-shift_seed1.json").write_text(json.dumps(broken))
    process = reproduce(tmp_path, "dmc_pixels", "--only-draw")
    assert process.returncode == 0, process.stderr
    row = json.loads(process.stdout.splitlines()[-1])["panels"]["video"]["self-prediction-shift"]
    assert (row["runs"], row["stopped"]) == (2, 1)
    assert row["final_return_eval"] == [pytest.approx(sum(recorded["final_return_by_split"]["eval"]) / 20, rel=0.01)]
    assert "Broke off" in (folder / "table.md").read_text()


def test_a_training_is_kept_where_reading_its_results_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import reproduce as sweep

    def zoo(command: list[str]) -> None:
        trainings.append(command)
        run = tmp_path / "run" / "bisim_sac" / "task_1"
        (run / "task").mkdir(parents=True)
        (run / "task" / "config.yml").write_text("{}")
        np.savez(run / "evaluations.npz", timesteps=[50, 100], results=[[1.0], [2.0]])

    trainings: list[list[str]] = []
    monkeypatch.setattr("sb3_robust_bisim.cli.zoo.main", zoo)
    read = sweep.collect
    run = (["--device", "cpu"], tmp_path / "run", tmp_path / "run.json", {"steps": 100, "eval_freq": 50}, "commit", ())
    monkeypatch.setattr(sweep, "collect", lambda folder: 1 / 0)
    assert "ZeroDivisionError" in sweep.train(*run)["failed"]
    monkeypatch.setattr(sweep, "collect", read)
    assert [evaluation["step"] for evaluation in sweep.train(*run)["evaluations"]] == [50, 100]
    assert len(trainings) == 1


def test_a_folder_that_cannot_be_written_is_named_before_the_first_run(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from reproduce import check_writable

    check_writable("--out", tmp_path / "new")
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit, match=r"--out .*file/results: Not a directory\. Name a folder"):
        check_writable("--out", tmp_path / "file" / "results")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("tetris",), "invalid choice: 'tetris'"),
        (("cartpole", "--methods", "DQN"), "--methods DQN: cartpole has SAC, DBC"),
        (("cartpole", "--panels", "N_m=9"), "--panels N_m=9: cartpole has N_m=0"),
        (("cartpole", "--params", "batchsize:16"), "unknown key 'batchsize', did you mean 'batch_size'"),
        (("cartpole", "--params", "batch_size=16"), "--params: unknown key 'batch_size=16'"),
        (("cartpole", "--params", "batch_size"), "batch_size: write KEY:VALUE"),
        (("cartpole", "--seeds", "0"), "--seeds 0: must be at least 1"),
        (("cartpole", "--device", "quantum"), "--device quantum: there is none here"),
        (("cartpole", "--backend", "dask"), "--backend dask and --scheduler ADDRESS belong together"),
    ],
)
def test_wrong_arguments_are_named_before_anything_runs(arguments, named, tmp_path) -> None:
    process = reproduce(tmp_path, *arguments)
    assert process.returncode == 2
    assert named in process.stderr
    assert not list(tmp_path.iterdir())
