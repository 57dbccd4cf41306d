"""What an installation brings along: its licences, and pins and ranges of versions that agree. Nothing asks the network."""

import subprocess
import sys
from importlib.metadata import version

import pytest
from licences import ROOT, closure, is_copyleft, licence, requirements
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

# LGPL, imported and not changed, by packages that we need; docs/licences.md says which
LGPL = {"chardet", "pygame", "pygame-ce"}
PINS = {
    canonicalize_name(requirement.name): requirement
    for line in (ROOT / "constraints.txt").read_text().splitlines()
    if line and not line.startswith("#")
    for requirement in [Requirement(line)]
}
REQUIRED = [*requirements(), *requirements("all")]


def pinned(name: str) -> str:
    """The version in constraints.txt."""
    (specifier,) = PINS[name].specifier
    return specifier.version


def test_nothing_in_a_plain_installation_is_copyleft_but_two_libraries_under_the_lgpl() -> None:
    found = {name: licence(package) for name, package in closure(requirements()).items()}
    assert {"torch", "numpy", "stable-baselines3", "rl-zoo3", "gymnasium"} <= found.keys()
    assert {name: text for name, text in found.items() if is_copyleft(text) and name not in LGPL} == {}
    assert {name: text for name, text in found.items() if name in LGPL and "Lesser" not in text and "LGPL" not in text} == {}
    assert {name for name, text in found.items() if text == "unknown"} == set()


@pytest.mark.parametrize(
    ("text", "copyleft"),
    [
        ("GPL-3.0-only", True),
        ("LGPL-2.1-or-later", True),
        ("GNU Affero General Public License v3", True),
        ("GNU Lesser General Public License v2 or later (LGPLv2+)", True),
        ("AGPLv3", True),
        ("MPL-2.0 AND MIT", False),
        ("Apache-2.0 WITH LLVM-exception", False),
    ],
)
def test_copyleft_licences_are_recognised(text: str, copyleft: bool) -> None:
    assert is_copyleft(text) == copyleft


def test_the_page_of_licences_has_what_is_installed() -> None:
    page = (ROOT / "docs" / "licences.md").read_text()
    for name, package in closure(requirements()).items():
        if package.version == pinned(name):  # another version may have another licence
            assert f"| {name} | {pinned(name).partition('+')[0]} | {licence(package)} |" in page, "make licences"


def test_every_pin_is_in_the_range_of_setup_cfg() -> None:
    outside = [
        f"{requirement} but {pinned(canonicalize_name(requirement.name))}"
        for requirement in REQUIRED
        if not requirement.specifier.contains(pinned(canonicalize_name(requirement.name)), prereleases=True)
    ]
    assert outside == []


def test_everything_that_an_installation_with_all_extras_brings_is_pinned() -> None:
    assert closure(REQUIRED).keys() - PINS.keys() == set()


def test_every_requirement_has_a_lower_bound_that_is_not_above_what_is_installed() -> None:
    runtime = [*requirements(), *(r for extra in ("dmc", "theory", "sweep", "test") for r in requirements(extra))]
    for requirement in runtime:
        if requirement.name == "rl_zoo3" and not requirement.specifier:  # `plots` adds an extra to the one above
            continue
        assert any(specifier.operator == ">=" for specifier in requirement.specifier), f"{requirement}: has no lower bound"
        assert requirement.specifier.contains(version(requirement.name), prereleases=True)


# Hides what a plain installation does not bring, then imports what the commands import
PLAIN = """
import sys
from importlib.metadata import packages_distributions
from packaging.utils import canonicalize_name

plain = set(sys.argv[1:])
hidden = {module for module, names in packages_distributions().items() if not plain & set(map(canonicalize_name, names))}

class Hider:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in hidden:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Hider())
import rl_zoo3.enjoy, rl_zoo3.train
import sb3_robust_bisim.cli.zoo
"""


def test_the_commands_import_only_what_a_plain_installation_brings() -> None:
    plain = [*closure(requirements()), "sb3-robust-bisim"]
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", PLAIN, *plain], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
