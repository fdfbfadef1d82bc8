"""Compute a network's action values on all cores."""

import copy
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, Literal, Protocol, TypeVar, runtime_checkable

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from atlantis_exp.learning.objectives import action_values

T = TypeVar("T")


def generators_of(network: nn.Module) -> Iterator[tuple[str, torch.Generator]]:
    """Yield the name and the `generator` of each module of a network that has one."""
    for name, module in network.named_modules():
        if isinstance(generator := getattr(module, "generator", None), torch.Generator):
            yield name, generator


@runtime_checkable
class Recurrent(Protocol):
    """A network with a memory (B, units), which is zero when an episode begins."""

    units: int
    burn_in: int  # steps before those to learn, at least one, which only recompute the memory
    unroll: int  # steps to learn at once

    def sequence(
        self, x_BTCHW: torch.Tensor, h_BU: torch.Tensor, first_B: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the values (B, T, A), or quantiles (B, T, A, N), of T states, and the memory after them.

        The memory is zero before step `first` of a sequence.
        """
        ...


def channels_last(states: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return states (B, C, H, W) as (B, H, W, C)."""
    batch, channels, height, width = states.shape
    # OpenCV moves bytes: torch would take longer for it than a network's input takes otherwise.
    bytes_BHWC = cv2.merge([states[:, channel].reshape(-1, width) for channel in range(channels)])
    return bytes_BHWC.reshape(batch, height, width, channels)  # type: ignore[return-value]


class Replicas:
    """Copies of a network, one a thread, that share buffers, generators and weights in the precision of the pass.

    In bfloat16 batch normalization stays float32. `refresh` them after an update.
    """

    def __init__(self, network: nn.Module, dtype: torch.dtype, count: int) -> None:
        self._masters: list[torch.Tensor] = [
            parameter
            for module in network.modules()
            if dtype is torch.bfloat16 and not isinstance(module, nn.modules.batchnorm._NormBase)
            for parameter in module.parameters(recurse=False)
        ]
        self._casts = [parameter.detach().to(dtype) for parameter in self._masters]
        if not self._casts and count == 1:
            self.networks = [network]
            return
        weights = {id(parameter): parameter.detach() for parameter in network.parameters()}
        weights |= {id(master): cast for master, cast in zip(self._masters, self._casts, strict=True)}
        shared = [*network.buffers(), *(generator for _, generator in generators_of(network))]
        self.networks = [
            copy.deepcopy(
                network,
                {id(each): each for each in shared}
                | {id(each): nn.Parameter(weights[id(each)], each.requires_grad) for each in network.parameters()},
            )
            for _ in range(count)
        ]

    @torch.no_grad()
    def refresh(self) -> None:
        if self._casts:
            torch._foreach_copy_(self._casts, self._masters)


class ActionValues:
    """Compute a network's action values in eval mode, on its device; precision, shards and errors as for `Learner`."""

    def __init__(self, network: nn.Module, *, precision: Literal["fp32", "bf16"] = "fp32", shards: int = 1) -> None:
        self.network = network.eval()
        self.dtype = torch.bfloat16 if precision == "bf16" else torch.float32
        self.device = next(network.parameters()).device
        if shards > 1 and not getattr(network, "splits_batches", False):
            raise ValueError("a network without splits_batches cannot split a batch into shards")
        self.shards = shards
        if shards > 1:
            self._threads = ThreadPoolExecutor(shards, "learner", partial(torch.set_num_threads, 1))
        self._online = Replicas(network, self.dtype, shards)

    def q_values(self, states: npt.NDArray[np.uint8], replicas: Replicas | None = None) -> npt.NDArray[np.float32]:
        """Return the values (B, A) that the network, or one with `replicas`, gives states (B, C, H, W) in 0..255."""
        return np.concatenate(self._map_shards(partial(self._values, replicas or self._online), self._shards(states)))

    @torch.inference_mode()
    def _values(self, replicas: Replicas, shard: int, states: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        q = replicas.networks[shard](self._input(states)).float()
        values: npt.NDArray[np.float32] = action_values(q).cpu().numpy()
        return values

    def step(
        self, states: npt.NDArray[np.uint8], memory: npt.NDArray[np.float32], replicas: Replicas | None = None
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Return the values (B, A) that a recurrent network gives states, and its memory (B, units) after them."""
        parts = self._map_shards(partial(self._step, replicas or self._online), self._shards(states, memory))
        values, after = zip(*parts, strict=True)
        return np.concatenate(values), np.concatenate(after)

    @torch.inference_mode()
    def _step(
        self, replicas: Replicas, shard: int, states: npt.NDArray[np.uint8], memory: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        x_B1CHW, never_B = self._input(states).unsqueeze(1), torch.full((len(states),), -1, device=self.device)
        q, after = replicas.networks[shard].sequence(x_B1CHW, self._sent(memory), never_B)  # type: ignore[operator]
        return action_values(q[:, 0].float()).cpu().numpy(), after.float().cpu().numpy()

    def _shards(self, *batch: npt.NDArray[Any]) -> list[tuple[npt.NDArray[Any], ...]]:
        """Split the arrays of a batch into non-empty shards."""
        count = min(self.shards, len(batch[0]))
        return [*zip(*(np.array_split(array, count) for array in batch), strict=True)]

    def _map_shards(self, function: Callable[..., T], shards: Sequence[tuple[npt.NDArray[Any], ...]]) -> list[T]:
        """Call a function with each shard's number and arrays, in a thread each; a single one in this thread."""
        over = map if len(shards) == 1 else self._threads.map
        return [*over(function, range(len(shards)), *zip(*shards, strict=True))]

    def _input(self, states: npt.NDArray[np.uint8]) -> torch.Tensor:
        """Return states in [0, 1] in the precision of the forward pass, channels last."""
        x_BHWC = self._sent(channels_last(states))
        return x_BHWC.to(self.dtype).div_(255).permute(0, 3, 1, 2)

    def _sent(self, array: npt.NDArray[Any]) -> torch.Tensor:
        tensor = torch.from_numpy(array)
        if self.device.type != "cuda":
            return tensor.to(self.device)
        # A copy from pageable memory waits for all earlier work of the GPU.
        return tensor.pin_memory().to(self.device, non_blocking=True)
