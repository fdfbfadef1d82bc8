"""The residual network of the report."""

import torch
from torch import nn

from atlantis_exp.networks.dropout import Dropout
from atlantis_exp.networks.heads import Head
from atlantis_exp.networks.sizes import shapes_of


class ResNetBlock(nn.Module):
    """A basic residual block (He et al. 2016, figure 2; option B of section 4.1), which the report does not show.

    With `out_channels` it halves the sides, rounding up, and projects its shortcut with a 1x1 convolution of stride 2.
    Only its activation differs from He et al.; unlike the report's stem it normalises before activating.
    """

    def __init__(self, in_channels: int, activation: type[nn.Module], out_channels: int | None = None) -> None:
        super().__init__()
        stride = 1 if out_channels is None else 2
        channels = out_channels or in_channels
        self.residual = nn.Sequential(
            nn.Conv2d(in_channels, channels, kernel_size=3, stride=stride, padding=1, bias=False),
            nn.BatchNorm2d(channels),
            activation(),
            nn.Conv2d(channels, channels, kernel_size=3, padding=1, bias=False),
            nn.BatchNorm2d(channels),
        )
        self.shortcut: nn.Module = nn.Identity()
        if out_channels is not None:
            self.shortcut = nn.Sequential(
                nn.Conv2d(in_channels, channels, kernel_size=1, stride=2, bias=False),
                nn.BatchNorm2d(channels),
            )
        self.activation = activation()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y: torch.Tensor = self.activation(self.residual(x) + self.shortcut(x))
        return y


class ResNetDQN(nn.Module):
    """Fourteen convolutions in the main path, four of them the stem, and two dense layers (report figure 2.2).

    Maps (B, C, H, W) in [0, 1] to the output of `head`, (B, num_actions) by default. The report fixes H = W = 159; here
    `input_shape` = (C, H, W) sizes the first dense layer.
    """

    smallest_side = 15  # pixels: 15 -> 7 -> 5 -> 3 -> 1

    def __init__(self, input_shape: tuple[int, int, int], num_actions: int, head: Head = nn.Linear) -> None:
        super().__init__()
        self.block1 = nn.Sequential(  # 159x159
            nn.Conv2d(input_shape[0], 16, kernel_size=3, stride=2),  # 79x79
            nn.SiLU(inplace=True),
            nn.BatchNorm2d(16),
            nn.Conv2d(16, 32, kernel_size=3),  # 77x77
            nn.SiLU(inplace=True),
            nn.BatchNorm2d(32),
            nn.Conv2d(32, 32, kernel_size=3),  # 75x75
            nn.SiLU(inplace=True),
            nn.BatchNorm2d(32),
            nn.Conv2d(32, 32, kernel_size=3, stride=2),  # 37x37
        )
        self.feature_extraction = nn.Sequential(
            ResNetBlock(32, nn.SiLU, 64),  # 19x19
            ResNetBlock(64, nn.SiLU),
            ResNetBlock(64, nn.SiLU),
            ResNetBlock(64, nn.SiLU, 128),  # 10x10
            ResNetBlock(128, nn.SiLU),
        )
        self.regression = nn.Sequential(
            Dropout(0.3),
            nn.Linear(shapes_of((*self.block1, *self.feature_extraction), input_shape)[-1].numel(), 1024),
            Dropout(0.2),
            nn.SiLU(inplace=True),
            head(1024, num_actions),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        # On CPUs with AVX-512 this makes an update 12 % faster in float32 and 7 % in bfloat16.
        x = x.contiguous(memory_format=torch.channels_last)
        q: torch.Tensor = self.regression(self.feature_extraction(self.block1(x)).flatten(1))
        return q
