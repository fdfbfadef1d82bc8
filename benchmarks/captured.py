"""Compare whole updates as one CUDA graph with plain and compiled ones: `python -m benchmarks.captured`.

A turn is the learner's part of 32 steps of `experiment=fast`: an update, then the values of 16 states twice. The plain
learner starts hundreds of kernels for it, one by one; `compile=true` makes graphs of the passes only. Here one graph
has the update from the sent batch to the optimizer's step, another the values. The seldom moves of the target network
and the average stay outside, as do emulation and sampling.

First it makes updates both ways and compares all tensors, bit by bit. A learning rate in a graph is a tensor, so it is
one for the plain learner, too. `--rehearse` does everything without graphs, on a CPU too: its speed means nothing.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
import torch

from atlantis_exp.build import build_learner, choose_device
from atlantis_exp.learning.learner import Learner
from atlantis_exp.learning.objectives import action_values
from atlantis_exp.learning.values import channels_last, generators_of
from atlantis_exp.sessions.processor import set_up_torch
from benchmarks.composition import composed
from benchmarks.contest import calls_per_second, parser_of, print_results, print_table, run, take_turns

Arrays = Sequence[npt.NDArray[Any]]
Work = Callable[[], torch.Tensor]
Capture = Callable[[Learner, Work], Work]
_WARM_UP = 3  # plain updates first: they create the optimizer's state and let cuDNN choose


class Captured:
    """A learner's update and values as two graphs; the last is of a fixed number of states.

    capture: returns a function that repeats the work on the same tensors, from the learner and the work.
    """

    def __init__(self, learner: Learner, capture: Capture) -> None:
        self._learner = learner
        self._capture = capture
        self._update: Work | None = None
        self._values: Work | None = None
        self._batch: list[torch.Tensor] = []
        self._states = torch.empty(0)
        self._count = torch.empty(0)  # updates, since a graph would keep an int

    def update(self, *batch: npt.NDArray[Any]) -> torch.Tensor:
        """Take one step as `Learner.update`, with equal weights."""
        learner = self._learner
        if learner.updates < _WARM_UP:
            return learner.update(*batch)
        arrays = _sent_by_an_update(*batch)
        if self._update is None:
            self._batch = [learner._sent(array).clone() for array in arrays]
            self._count = torch.full((), learner.updates, device=learner.device)
            self._update = self._capture(learner, lambda: self._work(*batch))
        self._copy(self._batch, arrays)
        errors = self._update()
        learner.updates += 1
        learner._measured += 1
        learner._move_target()
        learner._move_average()
        return errors

    def q_values(self, states: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        """Return the values (B, A) as `Learner.q_values`."""
        learner, merged = self._learner, channels_last(states)
        if self._values is None:
            self._states = learner._sent(merged).clone()
            self._values = self._capture(learner, lambda: self._q(states))
        self._copy([self._states], [merged])
        q: npt.NDArray[np.float32] = self._values().cpu().numpy()
        return q

    def milliseconds(self, calls: int = 50) -> float:
        """Return the time of an update and two actions, of many in a row; on a GPU of its work alone."""
        assert self._update is not None
        assert self._values is not None
        began = time.perf_counter()
        for _ in range(calls):
            self._update()
            self._values()
            last = self._values()
        last.cpu()
        return (time.perf_counter() - began) / calls * 1e3

    def _copy(self, buffers: Sequence[torch.Tensor], arrays: Arrays) -> None:
        for buffer, array in zip(buffers, arrays, strict=True):
            buffer.copy_(self._learner._sent(array), non_blocking=True)

    def _work(self, *batch: npt.NDArray[Any]) -> torch.Tensor:
        """Make an update of the buffers in place of the batch, without its moves."""
        learner = self._learner
        replaced: dict[str, Any] = {name: lambda: None for name in ("_move_target", "_move_average")}
        replaced |= {"updates": self._count, "_measured": learner._measured}
        replaced["_sent"] = self._buffers(self._batch, _sent_by_an_update(*batch))
        with patch.multiple(learner, **replaced):
            return learner.update(*batch)

    @torch.no_grad()
    def _q(self, states: npt.NDArray[np.uint8]) -> torch.Tensor:
        learner = self._learner
        with patch.multiple(learner, _sent=self._buffers([self._states], [channels_last(states)])):
            return action_values(learner._online.networks[0](learner._input(states)).float())

    def _buffers(self, buffers: Sequence[torch.Tensor], arrays: Arrays) -> Callable[..., torch.Tensor]:
        """Return a stand-in for `_sent`, which gives out buffers in turn and checks that they have these arrays."""
        each = zip(buffers, arrays, strict=True)

        def sent(array: npt.NDArray[Any]) -> torch.Tensor:
            buffer, expected = next(each)
            if not np.array_equal(array, expected):
                raise ValueError("an update sends other arrays than expected")
            return buffer

        return sent


def graph_of(learner: Learner, work: Work) -> Work:
    """Capture work in a CUDA graph; its replays draw dropout masks from the learner's generators."""
    graph = torch.cuda.CUDAGraph()
    for network in (learner.network, learner.target):
        for _, generator in generators_of(network):
            graph.register_generator_state(generator)
    torch.cuda.synchronize()
    with torch.cuda.graph(graph):
        result = work()

    def replay() -> torch.Tensor:
        graph.replay()
        return result

    return replay


def _sent_by_an_update(*batch: npt.NDArray[Any]) -> Arrays:
    """Return the arrays that an update sends to the device, in its order."""
    s_t, a_t, r_t, s_tpm, discount = batch
    return a_t, r_t, channels_last(s_tpm), discount, channels_last(s_t), np.ones(len(s_t), np.float32)


def learner_of(*overrides: str) -> tuple[Learner, Callable[[int], tuple[Any, ...]]]:
    """Return a learner whose learning rate is on the device, and a function that returns batches of noise."""
    config = composed("experiment=fast", "threads=1", *overrides)  # else it splits batches
    set_up_torch(config, config.device)
    learner = build_learner(config)
    for group in learner.optimizer.param_groups:
        group.update(capturable=learner.device.type == "cuda", lr=torch.tensor(group["lr"], device=learner.device))
    size, state = config.training.batch_size, config.env.state_shape

    def batch(seed: int) -> tuple[Any, ...]:
        rng = np.random.default_rng(seed)
        s_t, s_tpm = rng.integers(0, 256, (2, size, *state), np.uint8)
        discounts = rng.choice([0, 0.9], size).astype(np.float32)
        return s_t, rng.integers(4, size=size), rng.choice([0, 1], size).astype(np.float32), s_tpm, discounts

    return learner, batch


def are_equal(capture: Capture, *overrides: str, updates: int = 40) -> bool:
    """Return whether updates and values by graphs are the plain ones, bit by bit, while the learning rate falls."""
    plain, batch = learner_of(*overrides)
    other, _ = learner_of(*overrides)
    captured = Captured(other, capture)
    states = batch(updates)[0][:16]
    same = partial(torch.testing.assert_close, rtol=0, atol=0)
    try:
        for seed in range(updates):
            for learner in (plain, other):
                learner.optimizer.param_groups[0]["lr"].mul_(0.99)
            same(captured.update(*batch(seed)), plain.update(*batch(seed)))
            same(captured.q_values(states), plain.q_values(states))
        same(other.state_dict(), plain.state_dict())
    except AssertionError:
        return False
    return True


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and the JSON line."""
    parser = parser_of("captured", __doc__, rounds=5, seconds=2.0)
    parser.add_argument("--rehearse", action="store_true", help="make no graphs")
    parser.add_argument("--models", type=lambda names: names.split(","), default="cnn,resnet,resnet_fast", help="a,b")
    parser.add_argument("overrides", nargs="*", help="of the training, as objective=double_dqn")
    args = parser.parse_args(arguments)
    if not args.rehearse and choose_device("auto").type != "cuda":
        parser.error("torch finds no CUDA device here; --rehearse does without")
    capture: Capture = (lambda _, work: work) if args.rehearse else graph_of

    results: dict[str, Any] = {}
    rows = []
    for model in args.models:
        try:
            results[model] = each = _measured(capture, (f"model={model}", *args.overrides), args)
        except RuntimeError as error:  # which captured work can raise at any of its calls
            results[model] = str(error)
            rows.append((model, " ".join(str(error).split())[:60], *[""] * 5))
            continue
        shown = (f"{each[name]:.2f} ms" if name in each else "" for name in ("plain", "compiled", "captured"))
        shares = f"{each['plain'] / each['captured']:.2f}", f"{each['captured_alone'] / each['captured']:.0%}"
        rows.append((model, *shown, *shares, "yes" if each["equal"] else "no"))
    print_table("32 steps", ("", "plain", "compiled", "captured", "gain", "busy", "equal bits"), rows)
    print_results(results)


def _measured(capture: Capture, overrides: Sequence[str], args: argparse.Namespace) -> dict[str, float]:
    """Return whether the bits are equal, and the milliseconds of 32 steps by each learner."""
    equal = are_equal(capture, *overrides)
    learners = {
        name: learner_of(*overrides, f"compile={'true' if name == 'compiled' else 'false'}")
        for name in (("plain", "captured") if args.rehearse else ("plain", "compiled", "captured"))
    }
    captured = Captured(learners["captured"][0], capture)
    turns = {
        name: _turn(captured if name == "captured" else learner, batch(0), args.seconds)
        for name, (learner, batch) in learners.items()
    }
    each_ms = {name: 1e3 / statistics.median(rates) for name, rates in take_turns(turns, args.rounds).items()}
    return {"equal": equal, **each_ms, "captured_alone": captured.milliseconds()}


def _turn(by: Learner | Captured, batch: tuple[Any, ...], seconds: float) -> Callable[[], float]:
    """Return the measurement of how often a second an update and two actions of 16 states are made."""

    def work() -> None:
        by.update(*batch)
        for _ in range(2):
            by.q_values(batch[0][:16])

    for _ in range(_WARM_UP + 2):  # which compile or capture
        work()
    return lambda: calls_per_second(work, seconds)


if __name__ == "__main__":
    run(main)
