"""
The licences of everything that a plain `pip install sb3_robust_bisim` brings along.

    python tests/licences.py > docs/licences.md
"""

import configparser
import re
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
HEAD = """# Licences

This package is under the MIT licence. A plain `pip install sb3_robust_bisim` brings the packages below, without the extras.
`make licences` writes this page from the packages' own metadata. `tests/test_supply_chain.py` fails if one comes under the GPL
or the AGPL, or under the LGPL without being named there.

Two come under the LGPL, which allows programs under any licence to import them: `pygame-ce` (or `pygame`) draws Gymnasium's
classic control tasks, and `chardet` is needed by `pytablewriter`, which `rl_zoo3` needs. On Linux, the build of `torch` with
CUDA also brings NVIDIA's libraries, which have NVIDIA's own licences. The table is of the CPU build.
"""


def requirements(extra: str | None = None) -> list[Requirement]:
    """What setup.cfg asks for: the core, or one extra with the extras that it names."""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    text = config["options"]["install_requires"] if extra is None else config["options.extras_require"][extra]
    found = []
    for line in text.splitlines():
        if not line or line.startswith("#"):
            continue
        requirement = Requirement(line)
        if requirement.name == config["metadata"]["name"]:
            found += [inner for name in sorted(requirement.extras) for inner in requirements(name)]
        else:
            found.append(requirement)
    return found


def closure(roots: list[Requirement]) -> dict[str, Distribution]:
    """What these requirements install here, by canonical name. A package that is not installed is left out."""
    found: dict[str, Distribution] = {}
    seen: set[tuple[str, str]] = set()
    todo = [(requirement, extra) for requirement in roots for extra in ("", *requirement.extras)]
    while todo:
        requirement, extra = todo.pop()
        name = canonicalize_name(requirement.name)
        if (name, extra) in seen:
            continue
        seen.add((name, extra))
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            continue
        for needed in map(Requirement, found[name].requires or []):
            if needed.marker is None or needed.marker.evaluate({"extra": extra}):
                todo += [(needed, inner) for inner in ("", *needed.extras)]
    return dict(sorted(found.items()))


def licence(package: Distribution) -> str:
    """As its metadata names it: an SPDX expression, or else classifiers, or else the first line of the free text."""
    metadata = package.metadata
    if expression := metadata.get("License-Expression"):
        return expression
    classifiers = [line.split(" :: ")[-1] for line in metadata.get_all("Classifier") or [] if line.startswith("License ::")]
    named = [name for name in classifiers if name != "OSI Approved"]
    return ", ".join(named) or (metadata.get("License") or "unknown").strip().splitlines()[0]


def is_copyleft(text: str) -> bool:
    """True for the GPL, AGPL and LGPL in any spelling."""
    return re.search(r"\b(A|L)?GPL|General Public", text) is not None


def table() -> str:
    """The page docs/licences.md."""
    rows = [
        f"| {name} | {package.version.partition('+')[0]} | {licence(package)} |"
        for name, package in closure(requirements()).items()
    ]
    return "\n".join([HEAD, "| package | version | licence |", "|---|---|---|", *rows, ""])


if __name__ == "__main__":
    print(table(), end="")
