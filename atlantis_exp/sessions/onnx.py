"""Export a network to ONNX, to play without torch, and compare its values with torch's."""

import logging
import warnings
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from rich.text import Text
from torch import nn

from atlantis_exp.build import build_trained_network, make_emulator
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.game.preprocessing import FrameStack
from atlantis_exp.learning.objectives import action_values
from atlantis_exp.learning.values import ActionValues, Recurrent

Values = npt.NDArray[np.float32]  # (states, actions)
_TOLERANCE = 1e-4  # of the largest value, between float32 in torch and in ONNX Runtime


class Exported(NamedTuple):
    """A network as ONNX, and its difference from torch."""

    content: bytes
    states: int
    difference: float  # the largest, in a value


class _Values(nn.Module):
    """Maps states (B, C, H, W) in 0..255 to values of actions (B, A), as `ActionValues` does."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, states: torch.Tensor) -> torch.Tensor:
        return action_values(self.network(states.float().div(255)))


def require() -> None:
    """Raise ConfigError if the ONNX packages are not installed."""
    if not all(map(find_spec, ("onnx", "onnxscript", "onnxruntime"))):
        raise ConfigError("onnx=true: needs pip install 'atlantis-exp[onnx]'")


def export_onnx(config: Config, weights: bytes) -> Exported:
    """Return a network as ONNX: `states`, uint8 (batch, stack, size, size), to `q_values`, float32 (batch, actions).

    Raises: ConfigError for a network with a memory; Fault if the export fails, or its values in states of a game differ
    from torch's.
    """
    network = build_trained_network(config, weights).eval()
    if isinstance(network, Recurrent):
        raise ConfigError(f"onnx=true: model={config.model.name} has a memory, which the format's one input leaves out")
    shape = config.env.state_shape
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)  # torch warns that torchvision is missing
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                _Values(network).eval(),
                (torch.zeros(2, *shape, dtype=torch.uint8),),
                input_names=["states"],
                output_names=["q_values"],
                dynamic_shapes={"states": {0: torch.export.Dim("batch")}},
                dynamo=True,
                verbose=False,
            )
        assert program is not None
        content: bytes = program.model_proto.SerializeToString()
    except torch.onnx.OnnxExporterError as error:
        reason = " ".join(Text.from_ansi(str(error)).plain.split())
        raise Fault(f"the network cannot be written as ONNX: {reason}") from error
    finally:
        logging.disable(before)
    here, there = _both(config, network, content)
    difference = float(np.abs(here - there).max())
    if not difference <= _TOLERANCE * max(1.0, float(np.abs(here).max())):
        raise Fault(f"the ONNX network differs from torch's by up to {difference:g} in its values")
    return Exported(content, len(here), difference)


def _both(config: Config, network: nn.Module, content: bytes) -> tuple[Values, Values]:
    """Return the values of torch and of ONNX Runtime in states of a game with random actions."""
    import onnxruntime

    env, emulator = config.env, make_emulator(config.env)()
    stack = FrameStack(1, env.size, env.lags)
    stack.reset([0], emulator.reset(0)[np.newaxis])
    actions = np.random.default_rng(0).integers(len(emulator.game.actions), size=64).tolist()
    states = np.concatenate([stack.push(emulator.step(action).observation[np.newaxis]) for action in actions])
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    return ActionValues(network).q_values(states), session.run(None, {"states": states})[0]
