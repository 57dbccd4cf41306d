"""The memory of tensors, counted by the system in processes of their own."""

import platform
import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys
import numpy as np
from sb3_robust_bisim.runs.allocator import keep_freed_memory

if sys.argv[1] == "keep":
    assert keep_freed_memory()

def update():
    blocks = [np.ones(12 * 2**20, dtype=np.uint8) for _ in range(8)]  # 96 MiB, as many as an update from pixels needs

update()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    update()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other systems have other allocators")
def test_an_update_requests_no_memory_that_the_update_before_has_freed() -> None:
    def page_faults(mode: str) -> int:
        run = subprocess.run([sys.executable, "-c", PROGRAM, mode], capture_output=True, text=True, check=True)
        return int(run.stdout)

    default, kept = page_faults("default"), page_faults("keep")
    print(f"page faults of five updates: {default} by default, {kept} if memory is kept")
    assert default > 100  # as few with huge pages
    assert kept < default / 10
