"""Set up torch for a session's process, and name its processor."""

import platform
from contextlib import suppress

import torch

from atlantis_exp.build import choose_device, choose_shards
from atlantis_exp.config import Config
from atlantis_exp.learning.process import OWN_THREADS, set_up_process


def set_up_torch(config: Config, device: str) -> None:
    """Set up torch in this process for a config's network: one thread per shard of a batch, or all for the whole."""
    shards = choose_shards(config, choose_device(device))
    set_up_process((config.threads or OWN_THREADS) // shards)


def processor_name(device: torch.device) -> str:
    """Return a device's product name; a CPU's with its instruction set, on which the last bits depend."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    name = platform.processor() or platform.machine()  # Linux has no model in either
    with suppress(OSError), open("/proc/cpuinfo") as lines:
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    return f"{name}, {torch.backends.cpu.get_cpu_capability()}"
