"""The network of the DQN paper with a memory."""

import torch
from torch import nn

from atlantis_exp.components import Steps, Units
from atlantis_exp.networks.cnn import DQNCnn
from atlantis_exp.networks.heads import Head


class DQNCnnGru(DQNCnn):
    """DQNCnn with a gated recurrent unit before its head; R2D2 has an LSTM there (Kapturowski et al. 2019).

    `forward` takes each state as an episode's first; `sequence` carries the memory on.

    Args:
        units: numbers in the memory.
        burn_in: steps before those to learn, which only recompute the memory.
        unroll: steps to learn at once.
    """

    def __init__(
        self,
        input_shape: tuple[int, int, int],
        num_actions: int,
        head: Head = nn.Linear,
        *,
        units: Units,
        burn_in: Steps,
        unroll: Steps,
    ) -> None:
        super().__init__(input_shape, num_actions, lambda *_: nn.Identity())
        self.units, self.burn_in, self.unroll = units, burn_in, unroll
        self.core = nn.GRUCell(512, units)
        self.head = head(units, num_actions)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        first_B = torch.zeros(len(x), device=x.device)
        return self.sequence(x.unsqueeze(1), x.new_zeros(len(x), self.units), first_B)[0][:, 0]

    def sequence(
        self, x_BTCHW: torch.Tensor, h_BU: torch.Tensor, first_B: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the values (B, T, A) of T states and the memory after them, as `Recurrent` says."""
        batch = x_BTCHW.shape[:2]
        x_BTF = super().forward(x_BTCHW.flatten(0, 1)).reshape(*batch, -1)
        memories, h_BU = [], h_BU.to(x_BTF.dtype)
        for t in range(batch[1]):
            h_BU = self.core(x_BTF[:, t], torch.where((t > first_B).unsqueeze(1), h_BU, 0.0))
            memories.append(h_BU)
        q = self.head(torch.stack(memories, 1).flatten(0, 1))
        return q.reshape(*batch, *q.shape[1:]), h_BU
