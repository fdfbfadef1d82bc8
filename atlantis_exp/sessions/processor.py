"""Set up torch for a session's process, and name its processor."""

import platform
from contextlib import suppress

import torch

from atlantis_exp.build import choose_device, choose_shards
from atlantis_exp.config import Config
from atlantis_exp.learning.process import OWN_THREADS, keep_freed_memory


def set_up_torch(config: Config, device: str) -> None:
    """Set up torch in this process for a config's network: threads, determinism, memory.

    A shard of a batch has one thread, a whole batch all of them.
    """
    shards = choose_shards(config, choose_device(device))
    torch.set_num_threads((config.threads or OWN_THREADS) // shards)
    torch.backends.cudnn.deterministic = True  # else some GPU kernels add in any order
    torch.backends.cudnn.allow_tf32 = False  # fp32 means float32, not TensorFloat-32
    keep_freed_memory()


def processor_name(device: torch.device) -> str:
    """Return a device's product name; a CPU's with its instruction set, on which the last bits depend."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    name = platform.processor() or platform.machine()  # Linux has no model in either
    with suppress(OSError), open("/proc/cpuinfo") as lines:
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    return f"{name}, {torch.backends.cpu.get_cpu_capability()}"
