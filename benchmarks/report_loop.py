"""Transcribe the report's own loop (figures 2.3 to 2.5, 3.1 and 3.2), as a peer to measure against.

One environment; stacks of float32 frames; a queue of Python objects. Nothing is added or fixed, not even its aliasing
of state and next state. The report does not print its queue and how it draws a batch: they come from the code that it
builds on.
"""

import random
from collections import deque
from typing import Any, NamedTuple

import cv2
import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from atlantis_exp.networks.cnn import DQNCnn

Floats = npt.NDArray[np.float32]


class Experience(NamedTuple):
    state: Floats
    action: int
    reward: float
    next_state: Floats
    done: bool


class ReplayMemory:
    """A queue of experiences (section 4)."""

    def __init__(self, buffer_size: int, batch_size: int) -> None:
        self.batch_size = batch_size
        self.memory: deque[Experience] = deque(maxlen=buffer_size)

    def add(self, state: Floats, action: int, reward: float, next_state: Floats, done: bool) -> None:
        self.memory.append(Experience(state, action, reward, next_state, done))

    def sample(self) -> tuple[torch.Tensor, ...]:
        states, actions, rewards, next_states, dones = zip(*random.sample(self.memory, self.batch_size), strict=True)
        return (
            torch.from_numpy(np.array(states)).float(),
            torch.from_numpy(np.array(actions)).long(),
            torch.from_numpy(np.array(rewards)).float(),
            torch.from_numpy(np.array(next_states)).float(),
            torch.from_numpy(np.array(dones)).float(),
        )


class DQNAgent:
    """Figures 2.4 and 2.5."""

    def __init__(self, *, buffer_size: int, batch_size: int, learn_every: int, replay_after: int) -> None:
        self.gamma, self.tau = 0.99, 1e-4
        self.learn_every, self.replay_after = learn_every, replay_after  # steps, experiences
        self.action_size = 4
        self.policy_net = DQNCnn((4, 84, 84), self.action_size)
        self.target_net = DQNCnn((4, 84, 84), self.action_size)
        self.optimizer = torch.optim.AdamW(self.policy_net.parameters(), lr=1e-4)
        self.loss = nn.SmoothL1Loss()
        self.memory = ReplayMemory(buffer_size, batch_size)
        self.time_step = 0

    def act(self, state: Floats, eps: float) -> int:
        if torch.rand(1).item() < eps:
            return int(torch.randint(self.action_size, (1,)).item())
        self.policy_net.eval()
        with torch.no_grad():
            action_values = self.policy_net(torch.from_numpy(state).unsqueeze(0))
        self.policy_net.train()
        return int(action_values.argmax())

    def step(self, state: Floats, action: int, reward: float, next_state: Floats, done: bool) -> None:
        self.memory.add(state, action, reward, next_state, done)
        self.time_step = (self.time_step + 1) % self.learn_every
        if self.time_step == 0 and len(self.memory.memory) > self.replay_after:
            self.learn(*self.memory.sample())

    def learn(
        self,
        states: torch.Tensor,
        actions: torch.Tensor,
        rewards: torch.Tensor,
        next_states: torch.Tensor,
        dones: torch.Tensor,
    ) -> None:
        q_expected = self.policy_net(states).gather(1, actions.unsqueeze(1)).squeeze(1)
        targets_next = self.target_net(next_states).detach().max(dim=1)[0]
        q_targets = rewards + self.gamma * targets_next * (1 - dones)
        loss = self.loss(q_expected, q_targets)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        for target, policy in zip(self.target_net.parameters(), self.policy_net.parameters(), strict=True):
            target.data.copy_(self.tau * policy.data + (1.0 - self.tau) * target.data)


class Loop:
    """Figure 3.1, one step at a time."""

    def __init__(self, agent: DQNAgent, env: "gymnasium.Env[Any, Any]", eps: float) -> None:
        self.agent, self.env, self.eps = agent, env, eps
        self.state = stack_frame(None, preprocess_frame(env.reset(seed=0)[0]))

    def step(self) -> None:
        action = self.agent.act(self.state, self.eps)
        screen, reward, terminated, truncated, _ = self.env.step(action)
        next_state = stack_frame(self.state, preprocess_frame(screen))
        self.agent.step(self.state, action, float(reward), next_state, terminated or truncated)
        self.state = next_state
        if terminated or truncated:
            self.state = stack_frame(None, preprocess_frame(self.env.reset()[0]))


def preprocess_frame(screen: npt.NDArray[np.uint8]) -> Floats:
    """Figure 2.3, without its crop, which the peers lack: (210, 160, 3) to (84, 84)."""
    grey = cv2.cvtColor(screen, cv2.COLOR_RGB2GRAY)
    scaled = np.ascontiguousarray(grey, dtype=np.float32) / 255
    return np.asarray(cv2.resize(scaled, (84, 84), interpolation=cv2.INTER_AREA), np.float32)


def stack_frame(stacked_frames: Floats | None, frame: Floats) -> Floats:
    """Figure 2.3: it changes the stack in place and returns it."""
    if stacked_frames is None:
        return np.stack([frame] * 4)
    for index in range(3):
        stacked_frames[index] = stacked_frames[index + 1]
    stacked_frames[3] = frame
    return stacked_frames
