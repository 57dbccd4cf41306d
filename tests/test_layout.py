"""The house rules that a machine can check: allowed imports, and how much of SB3's `SAC.train` our `train` keeps."""

import ast
import difflib
import inspect
import textwrap
from pathlib import Path

import pytest
from stable_baselines3 import SAC

import sb3_robust_bisim
from sb3_robust_bisim import BisimSAC

PACKAGE = Path(sb3_robust_bisim.__file__).parent
# What each module or folder may import; `runs` and `callbacks` serve any model, `cli` may know everything
MAY_KNOW: dict[str, set[str]] = {
    "values": set(),
    "losses": set(),
    "augmentation": set(),
    "frame_buffer": {"runs"},
    "intrinsic_reward": set(),
    "update_log": set(),
    "data_checks": set(),
    "envs": {"runs", "values"},
    "theory": set(),
    "runs": {"values"},
    "encoders": {"losses"},
    "latent_models": {"losses"},
    "objective": {"latent_models", "losses", "metrics", "values"},
    "representation": {"latent_models", "losses", "metrics", "objective"},
    "metrics": {"losses"},
    "heads": {"encoders"},
    "policies": {"augmentation", "encoders", "heads", "latent_models", "objective", "representation"},
    "checks": {"policies", "values"},
    "bisim_sac": {
        *("checks", "data_checks", "frame_buffer", "heads", "intrinsic_reward", "objective", "policies", "runs", "update_log"),
    },
    "agent_files": {"encoders", "frame_buffer", "policies", "runs"},
    "export": {"agent_files", "bisim_sac", "checks"},
    "pretrained_encoder": {"agent_files", "encoders"},
    "callbacks": {"bisim_sac", "encoders", "envs", "frame_buffer", "losses", "theory", "values"},
    "cli": {"bisim_sac", "callbacks", "checks", "envs", "export", "frame_buffer", "runs"},
}


def floor_of(module: str) -> str:
    """The file or folder directly below the package."""
    return module.split(".")[1] if "." in module else ""


def imports() -> dict[str, set[str]]:
    """What each file or folder of the package imports from the others, including type-only imports."""
    found: dict[str, set[str]] = {}
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        modules = []
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                # `from sb3_robust_bisim import losses` names a module, too
                modules += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            elif isinstance(node, ast.Import):
                modules += [alias.name for alias in node.names]
        ours = {floor_of(module) for module in modules if module.split(".")[0] == PACKAGE.name}
        found.setdefault(name, set()).update(ours - {name, ""})
    return found


def test_each_part_imports_only_what_it_may_know() -> None:
    found = imports()
    assert {name: known for name, known in found.items() if name in MAY_KNOW and not known <= MAY_KNOW[name]} == {}
    assert found.keys() - MAY_KNOW.keys() == {"__init__", "__main__"}


def test_nothing_imports_in_a_circle() -> None:
    order: list[str] = []
    left = {name: MAY_KNOW[name] for name in MAY_KNOW}
    while left:
        free = [name for name, known in left.items() if known <= set(order)]
        assert free, f"a circle among {sorted(left)}"
        order += free
        left = {name: known for name, known in left.items() if name not in free}


def code_lines(method: object) -> list[str]:
    """The lines of a method without indentation, comments and docstring."""
    source = ast.unparse(ast.parse(textwrap.dedent(inspect.getsource(method))))  # type: ignore[arg-type]
    return [line.strip() for line in source.splitlines()][1:]


def test_train_reads_as_a_diff_against_sac() -> None:
    theirs, ours = code_lines(SAC.train), code_lines(inspect.unwrap(BisimSAC.train))
    blocks = difflib.SequenceMatcher(None, theirs, ours, autojunk=False).get_matching_blocks()
    kept = sum(block.size for block in blocks)
    print(f"{kept} of the {len(theirs)} code lines of SAC.train stand in BisimSAC.train, in order")
    assert kept >= 35


@pytest.mark.parametrize(("name", "most"), [("bisim_sac", 300), ("policies", 200), ("representation", 200), ("losses", 200)])
def test_the_core_stays_short(name: str, most: int) -> None:
    assert len((PACKAGE / f"{name}.py").read_text().splitlines()) <= most
