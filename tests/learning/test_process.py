import subprocess
import sys

import pytest

_PROBE = """
import resource
from atlantis_exp.learning.process import keep_freed_memory
{call}
size = 64_000_000  # bytes; the default keeps up to 32 MiB
b"x" * size
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(3):
    b"x" * size
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def _faults(call: str) -> int:
    return int(subprocess.run([sys.executable, "-c", _PROBE.format(call=call)], capture_output=True, check=True).stdout)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="speaks to glibc")
def test_freed_memory_comes_back_without_page_faults() -> None:
    assert _faults("keep_freed_memory()") < 30 < _faults("pass")
