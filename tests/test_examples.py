"""Every script of examples/ runs as it is, and the notebook was executed and still runs."""

import json
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest
from small_models import events
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_robust_bisim import BisimSAC

EXAMPLES = Path(__file__).parents[1] / "examples"
SCRIPTS = sorted(path.name for path in EXAMPLES.glob("*.py"))
NOTEBOOK = EXAMPLES / "cartpole.ipynb"
STEPS = 40


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    return tmp_path


def run(script: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> tuple[dict[str, Any], str]:
    """The variables and the output of a script, which runs in this process. A new one would import torch again."""
    monkeypatch.setattr(sys, "argv", [script, "--steps", str(STEPS)])
    return runpy.run_path(str(EXAMPLES / script), run_name="__main__"), capsys.readouterr().out


@pytest.mark.parametrize("script", SCRIPTS)
def test_an_example_trains_and_says_what_came_out(
    script: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    if script == "pixels.py":
        pytest.importorskip("dm_control")
    variables, output = run(script, monkeypatch, capsys)
    model = variables.get("model", variables.get("ppo"))
    assert model.num_timesteps >= STEPS
    assert model._n_updates > 0
    if script == "watch_embedding.py":
        found: EventAccumulator = events(folder / "logs")
        assert [image.step for image in found.Images("embedding/pca")] == [8, 16, 24, 32, 40]
        assert list(folder.rglob("tensors.tsv"))
    else:
        assert re.search(r"Return.*: \d+", output)
    if script == "cartpole.py":
        assert BisimSAC.load("cartpole.zip").num_timesteps == STEPS
    if script == "encoder_in_ppo.py":
        assert not any(parameter.requires_grad for parameter in model.policy.features_extractor.parameters())


def test_every_example_is_listed_and_has_a_docstring_of_two_lines() -> None:
    listed = re.findall(r"^\| \[([\w.]+)\]\(\1\)", (EXAMPLES / "README.md").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted([*SCRIPTS, NOTEBOOK.name])
    for script in SCRIPTS:
        assert re.match(r'"""[^\n"]+\n[^\n"]+"""\n', (EXAMPLES / script).read_text()), script


def test_the_notebook_has_its_outputs_and_runs() -> None:
    assert NOTEBOOK.stat().st_size < 300_000
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert "error" not in {output["output_type"] for output in outputs}
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    variables: dict[str, Any] = {}
    for number, cell in enumerate(cells, start=1):
        source = re.sub(r"^STEPS = \d[\d_]*", f"STEPS = {STEPS}", "".join(cell["source"]), flags=re.MULTILINE)
        exec(compile(source, f"{NOTEBOOK.name}, cell {number}", "exec"), variables)
    assert variables["model"].num_timesteps == STEPS
